#!/usr/bin/env python3
"""What the program does to files, signals, terminals and memory: behaviour_test.py PROGRAM [--update] [NAME...]

--update pins the heights that are made now, in tests/golden/heights.sha256.
"""
import array
import gzip
import hashlib
import http.client
import json
import math
import os
import pty
import re
import resource
import select
import shutil
import signal
import struct
import subprocess
import sys
import time

sys.dont_write_bytecode = True  # the sources may lie in a folder that must stay clean
from harness import (EXAMPLE, ROOT, Skip, default_signals, expect, is_sanitized, run_tests, sha256, shared, snapshot, tool)
from raster_files import read_exr, read_glb, read_obj, read_ply, read_png16, read_tiff, same, write_tiff

PINNED = os.path.join(ROOT, "tests", "golden", "heights.sha256")
UTM = {"epsg": 32611, "origin": (400000.0, 3800000.0), "cell": (30.0, 30.0)}
FORMATS = ("exr", "tif", "png", "glb", "obj", "ply")


def wave(width, height):
    """Rough enough that its roughness can be measured, exact in float32 and the same on every machine."""
    state, values = 1, []
    for k in range(width * height):
        state = (state * 1103515245 + 12345) & 0x7fffffff
        i, j = k % width, k // width
        values.append(200 + (i * j % 97) / 8 + abs(i - j) / 4 + (state >> 24) / 64)
    return values


def write_dem(case, name="dem.tif", width=70, height=50, point=False, holes=False):
    values = wave(width, height)
    if holes:
        values = [math.nan if k % 89 < 3 or k % width < 2 else z for k, z in enumerate(values)]
    write_tiff(case.path(name), width, height, values, point=point, **UTM)
    return array.array("f", values)


# ---- equal bytes ----

def equal_bytes_without_fma(case):
    """The C library takes other instructions on processors without FMA and AVX2, and the last bit of its powers and
    cosines may change with them. glibc can be told to; other libraries ignore it."""
    older = dict(os.environ, GLIBC_TUNABLES="glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-FMA_Usable,-AVX2_Usable")
    commands = [("noise", "-n", 257, "--hurst", hurst, "-s", seed) for hurst in (0.1, 0.5, 0.8, 0.95) for seed in (1, 2, 3)]
    commands += [("synth", EXAMPLE, "-l", 2), ("synth", EXAMPLE, "-l", 2, "--hurst", 0.3)]
    for command in commands:
        case.run(*command, "--overwrite", "-q", "-o", "here.exr")
        case.run(*command, "--overwrite", "-q", "-o", "older.exr", env=older)
        expect(sha256(case.path("here.exr")) == sha256(case.path("older.exr")), f"{command}: different bytes")


def equal_bytes(name, *command):
    """The same command with 1, 2 and 5 threads, and again with 2, makes the same file."""
    def test(case):
        made = {}
        for run, threads in enumerate((1, 2, 5, 2)):
            case.run(*command, "--threads", threads, "-q", "-o", f"{run}.{name}")
            files = [f"{run}.{name}"] + ([f"{run}.json"] if name == "png" else [])
            made[run] = [sha256(case.path(file)) for file in files]
            for file in files:
                os.remove(case.path(file))
        expect(len(set(map(tuple, made.values()))) == 1, f"{command}: different bytes: {made}")

    test.name = f"equalBytesForAnyThreads_{command[0]}_{name}"
    return test


def heights_of(case, *command):
    case.run(*command, "--compression", "none", "-q", "-o", "pinned.exr")
    digest = hashlib.sha256(read_exr(case.path("pinned.exr")).values.tobytes()).hexdigest()
    os.remove(case.path("pinned.exr"))
    return digest


def pinned_heights(case):
    """Heights and triangles are the same in every build: sanitized or not, with AVX2 or without. What is hashed comes from no
    other library, whose version might change it."""
    write_dem(case, "holes.tif", holes=True)
    write_dem(case, "point.tif", point=True)
    commands = {
        "synth-stationary": ("synth", EXAMPLE, "--levels", 2),
        "synth-square": ("synth", EXAMPLE, "--levels", 2, "--scheme", "square", "--seed", 11),
        "synth-smooth": ("synth", "point.tif", "--levels", 4, "--hurst", 0.95, "--delta", 3),
        "synth-rough-holes": ("synth", "holes.tif", "--levels", 3, "--hurst", 0.15, "--seed", 5),
        "noise-stationary": ("noise", "--size", 300, "--hurst", 0.3, "--seed", 2),
        "noise-square": ("noise", "--size", 129, "--hurst", 0.8, "--scheme", "square"),
    }
    found = {name: heights_of(case, *command) for name, command in commands.items()}
    for bound in (1, 20):
        case.run("simplify", EXAMPLE, "-e", bound, "--frame", "pixel", "-q", "-o", f"{bound}.ply")
        mesh = read_ply(case.path(f"{bound}.ply"))
        found[f"simplify-{bound}"] = hashlib.sha256(mesh.positions.tobytes() + mesh.indices.tobytes()).hexdigest()
    if "--update" in sys.argv:
        with open(PINNED, "w", encoding="ascii") as file:
            file.writelines(f"{digest}  {name}\n" for name, digest in sorted(found.items()))
    with open(PINNED, encoding="ascii") as file:
        want = {name: digest for digest, name in (line.split() for line in file)}
    for name in sorted(want.keys() | found.keys()):
        expect(found.get(name) == want.get(name), f"{name}: {found.get(name)}, pinned is {want.get(name)}")


def previews_are_equal_for_any_threads(case):
    write_dem(case, holes=True)
    for options in ((), ("-p",), ("--grey", "--beside", EXAMPLE, "--width", 300)):
        for dem in (EXAMPLE, "dem.tif"):
            made = set()
            for threads in (1, 2, 5):
                if "--beside" in options:
                    dem = EXAMPLE
                case.run("preview", dem, *options, "--height", 200, "-t", threads, "-q", "--overwrite", "-o", "a.png")
                made.add(sha256(case.path("a.png")))
            expect(len(made) == 1, f"{dem} {options}: {len(made)} different pictures")


# ---- nothing left behind ----

def lines_then_signal(case, command, count, number, twice=False):
    """Sends a signal when `count` lines of progress have been read; the exit status. The folder must be as it was, unless the
    program had finished before."""
    before = snapshot(case.folder)
    process = case.start(*command, "--progress", "json", preexec_fn=default_signals)
    said = b""
    while said.count(b"\n") < count:
        byte = process.stderr.read(1)
        if not byte:
            break
        said += byte
    process.send_signal(number)
    if twice:
        time.sleep(0.01)
        process.send_signal(number)
    _, rest = process.communicate(timeout=120)
    if process.returncode != 0:
        expect(snapshot(case.folder) == before, f"{command}: signal {number} after {count} lines left a file")
        expect(b"Sanitizer" not in said + rest, (said + rest).decode())
    return process.returncode, (said + rest).decode()


def interrupted(name, number):
    """In the middle of a synthesis that would take many seconds."""
    def test(case):
        for count in (1, 2, 4):
            status, said = lines_then_signal(case, ("synth", EXAMPLE, "-l", 8 if name != "png" else 6, "-o", f"a.{name}"),
                                             count, number)
            expect(status == 130, f"{count} lines: exit status {status}, not 130")
            expect(said.endswith("\ntalus: interrupted\n"), said)

    test.name = f"leavesNothingWhen{signal.Signals(number).name}_{name}"
    return test


def leaves_nothing_when_interrupted_early(case):
    """Before the handlers are in place the signal ends the process itself."""
    for delay in (0, 0.001, 0.003, 0.01, 0.03):
        before = snapshot(case.folder)
        process = case.start("synth", EXAMPLE, "-l", 8, "-o", "a.exr", preexec_fn=default_signals)
        time.sleep(delay)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=120)
        expect(process.returncode in (130, -signal.SIGINT), f"after {delay} s: exit status {process.returncode}")
        expect(snapshot(case.folder) == before, f"after {delay} s: a file was left")


def leaves_nothing_when_interrupted_twice(case):
    status, _ = lines_then_signal(case, ("synth", EXAMPLE, "-l", 8, "-o", "a.exr"), 2, signal.SIGINT, twice=True)
    expect(status in (130, -signal.SIGINT), f"exit status {status}")


def leaves_nothing_or_all_when_a_mesh_is_interrupted(case):
    for name in ("glb", "obj", "ply"):
        for count in (1, 2):
            status, _ = lines_then_signal(case, ("synth", EXAMPLE, "-l", 1, "-o", f"a.{name}"), count, signal.SIGTERM)
            expect(status in (0, 130), f"{name}: exit status {status}")
            if status == 0:  # the mesh was there before the signal
                {"glb": read_glb, "obj": read_obj, "ply": read_ply}[name](case.path(f"a.{name}"))
                os.remove(case.path(f"a.{name}"))


def leaves_nothing_when_killed(case):
    try:
        os.close(os.open(case.folder, os.O_TMPFILE | os.O_RDWR))
    except (AttributeError, OSError):
        raise Skip("this file system has no unnamed files")
    for name in ("exr", "tif", "png"):
        status, _ = lines_then_signal(case, ("synth", EXAMPLE, "-l", 6, "-o", f"a.{name}"), 2, signal.SIGKILL)
        expect(status == -signal.SIGKILL, f"exit status {status}")


def leaves_the_old_file_when_interrupted(case):
    with open(case.path("a.exr"), "w", encoding="ascii") as file:
        file.write("precious")
    status, _ = lines_then_signal(case, ("synth", EXAMPLE, "-l", 8, "--overwrite", "-o", "a.exr"), 2, signal.SIGINT)
    expect(status == 130, f"exit status {status}")


def command_for(name):
    return ("simplify", EXAMPLE, "-e", 20) if name in ("glb", "obj", "ply") else ("synth", EXAMPLE, "-l", 0)


def writers(case):
    """Command, output and its size, for each format."""
    found = [(command_for(name), f"a.{name}") for name in FORMATS] + [(("preview", EXAMPLE, "--height", 200), "look.png")]
    for command, output in found:
        case.run(*command, "-q", "-o", f"full.{output}")
        yield command, output, os.path.getsize(case.path(f"full.{output}"))


def tells_a_file_size_limit(case):
    """ulimit -f, whose signal must not kill the program; up to the last byte, where a buffer may hide the failure."""
    for command, output, size in writers(case):
        for limit in (0, 1000, size // 2, size - 1):
            result = case.run(*command, "-o", output, status=1,
                              preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)))
            # with a picture of heights comes a JSON file
            expect(re.fullmatch(r"talus: (a|look)\.\w+: cannot write: File too large\n", result.err),
                   f"{output}, limit {limit} of {size}: {result.err}")


def mounted_run(case, size, *command):
    """Runs the program in a small file system of its own, which only it sees; what it said and left."""
    script = f'mount -t tmpfs -o size={size} none "$1" && cd "$1" && shift && "$@"; echo "status $?"; ls -A .'
    os.makedirs(case.path("disk"), exist_ok=True)
    for unshare in (["unshare", "-m"], ["unshare", "-r", "-m"]):
        try:
            found = subprocess.run([tool("unshare"), *unshare[1:], "sh", "-c", script, "sh", case.path("disk"), case.program,
                                    *map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, timeout=120,
                                   check=False)
        except OSError as error:
            raise Skip(f"unshare: {error}")
        if b"status" in found.stdout and b"mount:" not in found.stderr:
            return found.stdout.decode(), found.stderr.decode()
    raise Skip("mounting is not permitted here")


def tells_a_full_disk(case):
    for command, output, size in writers(case):
        for share in (0.05, 0.5, 0.97):
            pages = max(1, int(size * share) // 4096)
            out, err = mounted_run(case, pages * 4096, *command, "-o", output)
            expect(out == "status 1\n", f"{output} on {pages} pages: {out}{err}")
            expect(re.fullmatch(r"talus: (a|look)\.\w+: cannot write: No space left on device\n", err), f"{output}: {err}")


def tells_an_unwritable_folder(case):
    with open(EXAMPLE, "rb") as example, open(case.path("dem.tif"), "wb") as copy:
        copy.write(example.read())
    os.mkdir(case.path("closed"), 0o555)
    nobody = (lambda: os.setuid(65534)) if os.getuid() == 0 else None
    try:
        case.start("version", preexec_fn=nobody).communicate()
    except OSError:
        raise Skip("the program's folder is closed to other users")
    for name in FORMATS:
        result = case.run("synth", "dem.tif", "-l", 0, "-o", f"closed/a.{name}", status=1, preexec_fn=nobody)
        expect(result.err == f"talus: closed/a.{name}: cannot write: Permission denied\n", result.err)


def refuses_to_replace(case):
    for name in FORMATS:
        case.run(*command_for(name), "-q", "-o", f"a.{name}")
        result = case.run(*command_for(name), "-o", f"a.{name}", status=1)
        expect("exists already" in result.err, result.err)
        case.run(*command_for(name), "-q", "--overwrite", "-o", f"a.{name}")
    os.remove(case.path("a.png"))
    result = case.run(*command_for("png"), "-o", "a.png", status=1)
    expect("a.json: exists already" in result.err, result.err)


def follows_the_umask(case):
    case.run("noise", "--size", 9, "-q", "-o", "a.exr", preexec_fn=lambda: os.umask(0o027))
    expect(os.stat(case.path("a.exr")).st_mode & 0o777 == 0o640, oct(os.stat(case.path("a.exr")).st_mode))


# ---- streams ----

def tells_a_full_stdout(case):
    for command in (("info", EXAMPLE), ("info", EXAMPLE, "--json"), ("help",), ("help", "synth"), ("version",)):
        if os.path.exists("/dev/full"):
            with open("/dev/full", "wb") as full:
                result = case.run(*command, status=1, stdout=full)
            expect(result.err == "talus: cannot write to standard output: No space left on device\n", result.err)
        result = case.run(*command, status=1, stdout=None, preexec_fn=lambda: os.close(1))
        expect(result.err == "talus: cannot write to standard output: Bad file descriptor\n", result.err)


def tells_a_broken_pipe(case):
    reader, writer = os.pipe()
    os.close(reader)
    result = case.run("info", EXAMPLE, status=1, stdout=writer)
    os.close(writer)
    expect(result.err == "talus: cannot write to standard output: Broken pipe\n", result.err)


def closed_streams_do_not_go_into_the_output(case):
    """The next file opened gets the number of a closed stream, and messages with it."""
    case.run("synth", EXAMPLE, "-l", 1, "-o", "open.exr")

    def close_all():
        for number in (0, 1, 2):
            os.close(number)

    process = case.start("synth", EXAMPLE, "-l", 1, "-o", "closed.exr", stdin=None, stdout=None, stderr=None,
                         preexec_fn=close_all)
    expect(process.wait(60) == 0, "failed")
    expect(sha256(case.path("open.exr")) == sha256(case.path("closed.exr")), "different bytes")


def on_terminal(case, *command):
    """What the program writes to a terminal that is its stderr."""
    try:
        master, slave = pty.openpty()
    except OSError as why:
        raise Skip(f"no terminal to be had: {why}") from why
    process = case.start(*command, stderr=slave, stdout=subprocess.DEVNULL)
    os.close(slave)
    said = b""
    while True:
        ready, _, _ = select.select([master], [], [], 60)
        try:
            part = os.read(master, 65536) if ready else b""
        except OSError:  # Linux: EIO when the last writer has closed
            part = b""
        if not part:
            break
        said += part
    os.close(master)
    expect(process.wait(60) == 0, said.decode())
    return said.decode()


def bar_only_on_a_terminal(case):
    command = ("synth", EXAMPLE, "-l", 3, "-o", "a.exr", "--overwrite")
    said = on_terminal(case, *command)
    expect(re.search(r"synthesis \[#+\.*\] +\d+ %  [\d.]+ M samples/s", said), repr(said))
    expect(re.search(r"\r\x1b\[Ka\.exr: 3224 x 2752 samples", said), "the bar is not removed: " + repr(said[-400:]))
    expect("[#" not in on_terminal(case, *command, "--progress", "none"), "a bar in spite of --progress none")
    expect(on_terminal(case, *command, "-q") == "", "words in spite of --quiet")
    piped = case.run(*command).err
    expect("\r" not in piped and "\x1b" not in piped and "[#" not in piped, repr(piped))
    expect(piped.startswith("a.exr: 3224 x 2752 samples"), piped)


def progress_lines_are_json(case):
    for name in ("exr", "png", "tif"):
        stages = {}
        for line in case.run("synth", EXAMPLE, "-l", 2, "--progress", "json", "-o", f"a.{name}").err.splitlines():
            if not line.startswith("{"):
                continue
            entry = json.loads(line)
            expect(set(entry) == {"stage", "done", "total", "seconds"}, line)
            expect(0 <= entry["done"] <= entry["total"] and entry["seconds"] >= 0, line)
            last = stages.get(entry["stage"], {"done": 0, "seconds": 0, "total": entry["total"]})
            expect(last["done"] <= entry["done"] and last["seconds"] <= entry["seconds"], f"{name}: goes back: {line}")
            expect(last["total"] == entry["total"], f"{name}: another total: {line}")
            stages[entry["stage"]] = entry
        expect(set(stages) == {"measuring", "synthesis"}, f"{stages}")
        expect(all(entry["done"] == entry["total"] for entry in stages.values()), f"not to the end: {stages}")


def quiet_is_silent(case):
    for command in (("synth", EXAMPLE, "-l", 1, "-o", "a.exr"), ("noise", "--size", 33, "-o", "b.exr"),
                    ("simplify", EXAMPLE, "-e", 9, "--verify", "-o", "c.ply"),
                    ("synth", EXAMPLE, "-l", 1, "--progress", "json", "-o", "d.exr")):
        result = case.run(*command, "--quiet")
        expect(result.out == "" and result.err == "", f"{command}: {result.out}{result.err}")


# ---- info ----

TYPES = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None), "integer": int,
         "number": (int, float)}
REMARKS = {"$schema", "title", "description"}


def is_of(value, name):
    return isinstance(value, TYPES[name]) and (name == "boolean" or not isinstance(value, bool))


def check_object(value, schema, where):
    for key in schema.get("required", []):
        expect(key in value, f"{where}: no {key}")
    for key, inner in value.items():
        rule = schema.get("properties", {}).get(key, schema.get("additionalProperties", True))
        expect(rule is not False, f"{where}: {key} is not in the schema")
        if rule is not True:
            check_schema(inner, rule, f"{where}.{key}")


def check_schema(value, schema, where="$"):
    """The keywords of JSON Schema that doc/info.schema.json uses, and no others."""
    known = {"type", "enum", "minimum", "required", "properties", "additionalProperties", "items", "minItems", "maxItems"}
    expect(not set(schema) - known - REMARKS, f"{where}: unknown keywords {set(schema) - known - REMARKS}")
    names = schema.get("type", list(TYPES))
    names = [names] if isinstance(names, str) else names
    expect(any(is_of(value, name) for name in names), f"{where}: {value!r} is no {names}")
    expect(value is None or value in schema.get("enum", [value]), f"{where}: {value!r}")
    if isinstance(value, (int, float)):
        expect(value >= schema.get("minimum", value), f"{where}: {value} is too small")
    elif isinstance(value, list):
        expect(schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)), f"{where}: {value}")
        for item in value:
            check_schema(item, schema.get("items", {}), where + "[]")
    elif isinstance(value, dict):
        check_object(value, schema, where)


def info_schema():
    with open(os.path.join(ROOT, "doc", "info.schema.json"), encoding="utf-8") as file:
        return json.load(file)


def json_keeps_its_schema(case):
    schema = info_schema()
    about = json.loads(case.run("info", EXAMPLE, "--json").out)
    check_schema(about, schema)
    expect((about["width"], about["height"], about["file"]["type"]) == (403, 344, "int16"), f"{about}")
    expect("window" not in about and "files" not in about, f"{about}")
    case.run("synth", EXAMPLE, "-l", 2, "-s", 4, "-q", "-o", "a.exr")
    made = json.loads(case.run("info", "a.exr", "--json").out)
    check_schema(made, schema)
    expect(made["file"] is None and made["level"] == 0, "an EXR is no GeoTIFF")
    expect(made["parameters"]["seed"] == "4" and made["parameters"]["levels"] == "2", f"{made['parameters']}")
    expect(all(abs(a - b) < 1e-9 for a, b in zip(made["georeference"]["extent"], about["georeference"]["extent"])),
           "the footprint has moved")
    for options in ({"point": True}, {"holes": True}):
        write_dem(case, "dem.tif", **options)
        check_schema(json.loads(case.run("info", "dem.tif", "--json").out), schema)
    values = [0.0] * 12
    for name, x in (("b.tif", 400000), ("c.tif", 400120)):
        write_tiff(case.path(name), 4, 3, values, False, (x, 3800000), (30, 30), 32611)
    both = json.loads(case.run("info", "b.tif", "c.tif", "--json").out)
    check_schema(both, schema)
    expect(len(both["files"]) == 2 and both["file"] is None, f"{both}")
    write_tiff(case.path("d.tif"), 4, 3, values)
    bare = json.loads(case.run("info", "d.tif", "--json").out)
    check_schema(bare, schema)
    expect(bare["georeference"]["extent_degrees"] is None, f"{bare}")
    wrong = {**about, "width": "403"}
    for broken in (wrong, {**about, "more": 1}, {k: v for k, v in about.items() if k != "level"}):
        try:
            check_schema(broken, schema)
        except AssertionError:
            continue
        raise AssertionError("the schema takes anything")


def reports_keep_their_schema(case):
    with open(os.path.join(ROOT, "doc", "report.schema.json"), encoding="utf-8") as file:
        schema = json.load(file)
    parts = ["framework", "amplification", "view", "stability"]
    if not is_sanitized(case.program):  # many exact fields, which have tests of their own
        parts.insert(1, "field")
    case.run("report", EXAMPLE, "--window", "100,100,80,72", "--quick", "-q", "--sections", ",".join(parts), "-o", "made")
    with open(case.path("made/report.json"), encoding="utf-8") as file:
        about = json.load(file)
    check_schema(about, schema)
    sections = [section["key"] for section in about["sections"]]
    expect(sections == parts, f"{sections}")
    tables = {table["key"]: table for section in about["sections"] for table in section["tables"]}
    for table in tables.values():
        keys = {column["key"] for column in table["columns"]}
        expect(table["rows"], f"{table['key']} is empty")
        expect(all(set(row) <= keys for row in table["rows"]), f"{table['key']} has values without a column")
        for plot in table["plots"]:
            expect({plot["x"], plot["y"]} <= keys, f"{plot}")
            with open(case.path(f"made/{plot['key']}.csv"), encoding="utf-8") as file:
                lines = file.read().splitlines()
            expect(len(lines) > 1 and len({len(line.split(",")) for line in lines}) == 1, f"{plot['key']}: {lines[:3]}")
    bounds = tables["bounds"]["rows"]
    expect(all(row["largest"] <= row["bound"] and row["verdict"] == "kept" for row in bounds), f"{bounds}")
    ends = {row["verdict"] for row in tables["cases"]["rows"]}
    expect(ends <= {"right", "refused"}, f"{ends}")
    depths = tables["precision"]["rows"]
    expect(len(depths) > 5 and all(0 < row["found"] <= row["bound"] and row["verdict"] == "right" for row in depths), f"{depths}")
    by = {(row["method"], row["factor"]): row for row in tables["methods"]["rows"]}
    expect(by["terrain", 2]["slope"] < by["bilinear", 2]["slope"], "detail is no better than none")
    with open(case.path("made/report.html"), encoding="utf-8") as file:
        page = file.read()
    expect(page.count("<section>") == len(parts), "no page")
    expect("<script" not in page and "src=" not in page, "the page needs something beside it")
    if shutil.which("gnuplot"):
        expect(page.count("<svg") == sum(len(table["plots"]) for table in tables.values()), "plots are missing")
    case.run("report", EXAMPLE, "--quick", "-o", "made", status=1)
    case.run("report", EXAMPLE, "--sections", "fields", "-o", "other", status=2)
    case.run("report", EXAMPLE, status=2)


def mbtiles_hold_the_folder(case):
    import sqlite3
    options = ("tiles", EXAMPLE, "--error", 50, "--levels", "0..10", "-q", "-o", "site")
    case.run(*options, "--mbtiles", "site.mbtiles")
    with sqlite3.connect(case.path("site.mbtiles")) as database:
        rows = list(database.execute("select zoom_level, tile_column, tile_row, tile_data from tiles"))
        facts = dict(database.execute("select name, value from metadata"))
    database.close()
    for level, column, row, data in rows:
        with open(case.path(f"site/{level}/{column}/{row}.terrain"), "rb") as file:
            expect(file.read() == data, f"{level}/{column}/{row} is another tile")
    files = sum(name.endswith(".terrain") for _, _, names in os.walk(case.path("site")) for name in names)
    expect(len(rows) == files > 10, f"{len(rows)} of {files} tiles")
    with open(case.path("site/layer.json"), encoding="utf-8") as file:
        expect(json.loads(facts["json"]) == json.load(file) and facts["maxzoom"] == "10", f"{facts}")
    first = sha256(case.path("site.mbtiles"))
    case.run(*options, "--resume", "--mbtiles", "again.mbtiles")
    expect(sha256(case.path("again.mbtiles")) == first, "the file is not the same again")
    case.run(*options, "--resume", "--mbtiles", "again.mbtiles", status=1)
    case.run("tiles", EXAMPLE, "-f", "exr", "-o", "heights", "--mbtiles", "h.mbtiles", status=2)


def statistics_keep_their_schema(case):
    with open(os.path.join(ROOT, "doc", "stats.schema.json"), encoding="utf-8") as file:
        schema = json.load(file)
    about = json.loads(case.run("stats", EXAMPLE, "--json").out)
    check_schema(about, schema)
    expect(about["estimates"][0]["hurst"] > 1 and about["estimates"][0]["delta"] is None, f"{about['estimates']}")
    write_tiff(case.path("flat.tif"), 4, 3, [0.0] * 12)
    flat = json.loads(case.run("stats", "flat.tif", "--json").out)
    check_schema(flat, schema)
    expect(all(e["refusal"] for e in flat["estimates"]), f"{flat}")
    case.run("noise", "--size", 129, "--hurst", 0.6, "-q", "-o", "noise.tif")
    said = case.run("stats", "noise.tif", "-q", "--maps", "maps.tif", "--expect-hurst", 0.6, "--expect-delta", 1).out
    expect(said == "", said)
    maps = json.loads(case.run("info", "maps.tif", "--json").out)
    expect((maps["width"], maps["height"], maps["file"]["bands"]) == (3, 3, 5), f"{maps}")
    failed = case.run("stats", "noise.tif", "-q", "--expect-hurst", 0.9, "--tolerance", 0.02, status=1)
    expect("standard error" in failed.err and "not within 0.02 of 0.9" in failed.err, failed.err)
    case.run("stats", "noise.tif", "--tolerance", 0.02, status=2)
    case.run("stats", "noise.tif", "-o", "plot.bmp", status=2)


def real_files_keep_the_schema(case):
    schema = info_schema()
    folder = shared("dem")
    for name in ("vanderford_bathy_64m_epsg3031_cog.tif", "ahn3_wcs_data.tif", "mmgis_missionDEM.tif", "N42E001.hgt",
                 "no_pixelscale_or_tiepoints.tiff"):
        path = os.path.join(folder, name)
        if os.path.exists(path):
            about = json.loads(case.run("info", path, "--json", "--window", "0,0,1,1").out)
            check_schema(about, schema)
            sizes = about["file"]["overview_sizes"]
            expect(len(sizes) == about["file"]["overviews"], f"{name}: {sizes}")
            expect(all(a[0] > b[0] and a[1] > b[1] for a, b in zip(sizes, sizes[1:])), f"{name}: {sizes}")


def window_costs_its_blocks(case):
    about = json.loads(case.run("info", EXAMPLE, "--json").out)
    width, height = about["width"], about["height"]
    across, down = about["file"]["block"]
    whole = json.loads(case.run("info", EXAMPLE, "--json", "--window", f"0,0,{width},{height}").out)["window"]
    expect(whole["blocks"] == -(-width // across) * -(-height // down), f"{whole}")
    expect(0 < whole["stored_bytes"] < about["file"]["bytes"], f"{whole}")
    one = json.loads(case.run("info", EXAMPLE, "--json", "--window", f"{width - 1},{height - 1},1,1").out)["window"]
    expect(one["blocks"] == 1 and one["stored_bytes"] < whole["stored_bytes"], f"{one}")
    expect(whole["decoded_bytes"] == one["decoded_bytes"] * whole["blocks"], f"{one}")
    for window in ("0,0,1", "-1,0,1,1", "0,0,0,1", "a,0,1,1", "0,0,1,1,1"):
        case.run("info", EXAMPLE, "--window=" + window, status=2)
    for option in (f"--window=0,0,{width + 1},1", f"--window=0,{height},1,1", "--bbox=0,0,1,1", "--bbox=1,1,0,0"):
        case.run("info", EXAMPLE, option, status=1)


def a_part_is_that_part(case):
    """By window and by box, in every command: the same samples, at their own place."""
    about = json.loads(case.run("info", EXAMPLE, "--json").out)["georeference"]
    part = json.loads(case.run("info", EXAMPLE, "--json", "--window", "100,200,50,40").out)
    check_schema(part, info_schema())
    west, south, east, north = part["georeference"]["extent"]
    cell = about["sample_transform"][1]
    expect(abs(west - about["extent"][0] - 100 * cell) < 1e-9 and abs(east - west - 50 * cell) < 1e-9, f"{part}")
    box = json.loads(case.run("info", EXAMPLE, "--json", f"--bbox={west},{south},{east},{north}").out)
    expect(box["window"] == part["window"] and box["heights"] == part["heights"], f"{box['window']}")
    case.run("synth", EXAMPLE, "-l", 0, "-q", "-o", "whole.tif")
    case.run("synth", EXAMPLE, "-l", 0, "-q", "--window", "100,200,50,40", "-o", "part.tif")
    again = json.loads(case.run("info", "whole.tif", "--json", "--window", "100,200,50,40").out)
    made = json.loads(case.run("info", "part.tif", "--json").out)
    expect(made["heights"] == again["heights"] == part["heights"], f"{made['heights']}")
    expect((made["width"], made["height"]) == (50, 40), f"{made}")
    case.run("simplify", EXAMPLE, "--window", "100,200,50,40", "-e", 5, "--verify", "-q", "-o", "part.ply")
    case.run("preview", EXAMPLE, "--window", "100,200,50,40", "-q", "-o", "part.png")
    case.run("info", EXAMPLE, "--window", "0,0,5,5", "--bbox", "0,0,1,1", status=1)


def corners_agree_with_gdal(case):
    """In degrees, where GDAL makes no change of datum of it."""
    tool("gdalinfo")
    folder = shared("dem")
    compared = 0
    for name in sorted(os.listdir(folder)):
        path = os.path.join(folder, name)
        if not name.endswith(".tif"):
            continue
        about = json.loads(case.run("info", path, "--json").out)
        g = about["georeference"]
        # GDAL makes cells of points, and changes the datum to WGS 84, on which these already are
        if about["raster_type"] != "area" or not g["crs"] or "WGS 84" not in g["crs"]["name"]:
            continue
        ring = json.loads(gdal(case, "gdalinfo", "-json", path))["wgs84Extent"]["coordinates"][0]
        ours = [g["corners_degrees"][k] for k in (0, 3, 2, 1)]
        for (a, b), (c, d) in zip(ours, ring):  # GDAL prints 7 decimals
            expect(abs(a - c) <= 0.6e-7 and abs(b - d) <= 0.6e-7, f"{name}: {ours} {ring}")
        compared += 1
    expect(compared, "nothing to compare")


def names_of_any_bytes(case):
    """A Latin-1 letter, a newline and a terminal's escape in the name of a file."""
    name = b"h\xf6he\n\x1b[31m.tif"
    write_tiff(os.path.join(os.fsencode(case.folder), name), 5, 4, [1.0] * 20, point=True, **UTM)
    argument = os.fsdecode(name)
    process = case.start("info", argument)
    out, err = process.communicate()
    expect(process.returncode == 0 and out.split(b"\n")[0] == b"h\xf6he??[31m.tif", f"{out}{err}")
    about = json.loads(case.start("info", argument, "--json").communicate()[0].decode("utf-8"))
    expect(about["name"] == "h?he\n\x1b[31m.tif", f"{about['name']!r}")
    want = "h?he??[31m.tif"
    for ending in FORMATS:
        expect(case.start("synth", argument, "-l", 1, "-q", "-o", f"a.{ending}").wait() == 0, ending)
    with open(case.path("a.json"), encoding="utf-8") as file:
        expect(json.load(file)["parameters"]["input"] == want, "PNG's sidecar")
    expect(json.loads(case.run("info", "a.exr", "--json").out)["parameters"]["input"] == want, "EXR")
    expect(want in json.dumps(read_glb(case.path("a.glb")).about["asset"]), "GLB")
    expect(f"comment input: {want}" in read_ply(case.path("a.ply")).about, "PLY")
    missing = case.start("info", os.fsdecode(b"h\xf6\x1b.tif")).communicate()[1]
    expect(missing == b"talus: h??.tif: cannot read: No such file or directory\n", f"{missing}")


# ---- heights ----

def formats_hold_the_same_heights(case):
    """EXR, GeoTIFF, PNG, in each compression that the readers know; the example's rows run from south to north."""
    write_dem(case, holes=True)
    for dem, upside_down in ((EXAMPLE, True), ("dem.tif", False)):
        command = ("synth", dem, "-l", 1, "-q", "--overwrite")
        case.run(*command, "--compression", "none", "-o", "a.exr")
        truth = read_exr(case.path("a.exr"))
        case.run(*command, "-o", "b.exr")
        expect(read_exr(case.path("b.exr")).values.tobytes() == truth.values.tobytes(), "EXR: zip and none differ")
        for kind in ("none", "zip"):
            case.run(*command, "--compression", kind, "-o", "a.tif")
            found = read_tiff(case.path("a.tif"))
            expect((found.width, found.height) == (truth.width, truth.height), "size")
            for row in range(truth.height):
                other = truth.height - 1 - row if upside_down else row
                expect(found.values[other * truth.width:(other + 1) * truth.width].tobytes() ==
                       truth.values[row * truth.width:(row + 1) * truth.width].tobytes(), f"{kind}: row {row}")


def outputs_are_read_back(case):
    """info tells of every format what made it; heights that were read back are those that were written."""
    write_dem(case, holes=True)
    for ending in ("exr", "tif", "raw", "r16", "png"):
        case.run("synth", "dem.tif", "-l", 1, "--seed", 5, "-q", "-o", f"a.{ending}")
        told = json.loads(case.run("info", "--json", f"a.{ending}").out)
        expect(told["parameters"]["seed"] == "5" and told["parameters"]["input"] == "dem.tif", f"{ending}: {told['parameters']}")
        expect(told["georeference"]["crs"]["epsg"] == 32611, f"{ending}: {told['georeference']}")
        case.run("synth", f"a.{ending}", "-l", 0, "--support", "point", "--compression", "none", "-q", "-o", f"{ending}-again.exr")
    truth = read_exr(case.path("exr-again.exr")).values
    for ending in ("tif", "raw"):
        expect(read_exr(case.path(f"{ending}-again.exr")).values.tobytes() == truth.tobytes(), ending)
    with open(case.path("a.json"), encoding="utf-8") as file:
        step = json.load(file)["scale"]
    for ending in ("r16", "png"):
        for found, height in zip(read_exr(case.path(f"{ending}-again.exr")).values, truth):
            expect(same(found, height) or abs(found - height) <= 0.5 * step + 2e-5, f"{ending}: {found} for {height}")
    for ending in ("glb", "obj", "ply"):
        case.run("simplify", "dem.tif", "-e", 3, "-q", "-o", f"m.{ending}")
        told = json.loads(case.run("info", "--json", f"m.{ending}").out)
        with open(os.path.join(ROOT, "doc", "mesh_info.schema.json"), encoding="utf-8") as file:
            check_schema(told, json.load(file))
        expect(told["record"]["max_error"] == "3" and told["record"]["frame"] == "enu" and told["triangles"] > 0, f"{told}")
    case.run("simplify", "dem.tif", "-e", 3, "-q", "-o", "m.stl")
    expect("frame: enu" in case.run("info", "m.stl").out, "frame of the STL")


def sidecars_are_checked(case):
    """Heights without their JSON file, or with one that does not fit, are refused in one line."""
    write_dem(case)
    for ending, beside in (("raw", "a.raw.json"), ("r16", "a.r16.json"), ("png", "a.json")):
        case.run("synth", "dem.tif", "-l", 0, "-q", "-o", f"a.{ending}")
        with open(case.path(beside), encoding="utf-8") as file:
            good = file.read()
        about = json.loads(good)
        for text in (None, "", "[]", "{}", "{", good.replace(f'"width": {about["width"]}', '"width": -3'),
                     good.replace(f'"width": {about["width"]}', '"width": 2147483647'),
                     good.replace(f'"height": {about["height"]}', '"height": 3'),
                     re.sub(r'"(width|height|scale|offset)": [^,]*', r'"\1": 1e308', good)):
            os.unlink(case.path(beside))
            if text is not None:
                with open(case.path(beside), "w", encoding="utf-8") as file:
                    file.write(text)
            said = case.run("info", f"a.{ending}", status=1).err
            expect(said.count("\n") == 1 and f"a.{ending}" in said, f"{text}: {said}")
            with open(case.path(beside), "w", encoding="utf-8") as file:
                file.write(good)


def tiles_of_nothing_are_refused(case):
    """A DEM without a height makes no tiles; a dry run foresees all that there will be at most."""
    write_tiff(case.path("void.tif"), 60, 50, [math.nan] * 3000, point=False, **UTM)
    said = case.run("tiles", "void.tif", "-o", "none", status=1).err
    expect("no height is known" in said and not os.path.exists(case.path("none")), said)
    foreseen = case.run("tiles", EXAMPLE, "-l", "0..9", "--dry-run", "-o", "none").err
    made = case.run("tiles", EXAMPLE, "-l", "0..9", "-o", "some").err
    most, tiles = (int(re.search(pattern, text).group(1)) for pattern, text in ((r"at most (\d+) tiles", foreseen), (r"some: (\d+) tiles", made)))
    expect(tiles <= most <= tiles + 4, f"{foreseen} {made}")


def dry_runs_foresee_within_two(case):
    """Bytes and processor time to expect are within a factor of two, of a small model in many tiles and of a large one."""
    def seconds():
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime  # files are the system's time, as the disk has it
    models = [(EXAMPLE, ("-l", "10..15")), (EXAMPLE, ("-f", "exr", "--tile", 33))]
    try:
        models.append((shared("dem", "alps_srtm3_3601x2401_tiled_lzw_p2.tif"), ("-e", 30)))
    except Skip:
        pass
    for number, (model, options) in enumerate(models):
        words = ("tiles", model, "-t", 1, *options, "-o", f"site{number}")
        said = case.run(*words, "--dry-run").err
        expect(not os.path.exists(case.path(f"site{number}")), "a dry run made a folder")
        megabytes, foreseen = map(float, re.search(r"about ([0-9.e+]+) MB.*, and ([0-9.e+-]+) s with 1 thread", said).groups())
        before = seconds()
        made = int(re.search(r" tiles, (\d+) bytes", case.run(*words).err).group(1))
        took = seconds() - before
        expect(made / 2 < megabytes * 1e6 < made * 2, f"{model} {options}: {made} bytes; {said}")
        # starting takes longer than tens of milliseconds of work; sanitizers slow down what they like
        expect(is_sanitized(case.program) or took / 2 - 0.1 < foreseen < 2 * took + 0.1, f"{model} {options}: {took} s; {said}")


def points_and_tiles_are_read_back(case):
    """info tells of points, of folders of tiles and what is in them, and of what a preset writes; damage is told."""
    def about(name, schema):
        found = json.loads(case.run("info", "--json", name).out)
        with open(os.path.join(ROOT, "doc", schema), encoding="utf-8") as file:
            check_schema(found, json.load(file))
        expect(case.run("info", name).out.startswith(f"{name}\n"), name)
        return found
    for ending in ("geojson", "csv"):
        said = case.run("simplify", EXAMPLE, "-e", 20, "--features", "points", "--points", "-o", f"p.{ending}").err
        points = about(f"p.{ending}", "mesh_info.schema.json")
        expect(f"{points['vertices']} points" in said or str(points["vertices"]) in said, said)
        expect(points["low"][2] >= 200 and "summit" in points["record"]["features"], points)
        with open(case.path(f"p.{ending}"), "rb") as file:
            whole = file.read()
        with open(case.path(f"cut.{ending}"), "wb") as file:
            file.write(whole[:len(whole) // 2])
        refused = case.run("info", f"cut.{ending}", status=1).err
        expect("as talus writes it" in refused, refused)
    expect(about("p.geojson", "mesh_info.schema.json")["record"]["max_error"] == "20", "the bound")
    case.run("tiles", EXAMPLE, "-q", "-o", "globe")
    pyramid = about("globe", "tiles_info.schema.json")
    names = [os.path.join(where, name) for where, _, files in os.walk(case.path("globe")) for name in files
             if name.endswith(".terrain")]
    expect(pyramid["tiles"] == len(names), pyramid)
    deepest = max(names, key=lambda name: int(name.split("/")[-3]))
    level, column, row = deepest[:-len(".terrain")].split("/")[-3:]
    tile = about(f"globe/{level}/{column}/{row}.terrain", "mesh_info.schema.json")
    expect(tile["record"]["tile"].startswith(f"level {level}, column {column}, row {row} "), tile)
    expect(abs(tile["low"][0] - (int(column) * 180 / 2 ** int(level) - 180)) < 1e-9 and tile["triangles"] > 0, tile)
    with open(case.path("torn.terrain"), "wb") as torn, open(deepest, "rb") as file:
        torn.write(file.read()[:-100])
    expect("as talus writes it" in case.run("info", "torn.terrain", status=1).err, "a torn tile")
    case.run("tiles", EXAMPLE, "--format", "3dtiles", "-q", "-o", "city")
    expect(about("city", "tiles_info.schema.json")["geometric_error"] > 0, "3D Tiles")
    write_dem(case, width=170, height=160)
    case.run("synth", "dem.tif", "-l", 1, "--preset", "unity", "--tile", 129, "-q", "-o", "land.r16")
    tiles = about("land_x1_y0.r16", "tiles_info.schema.json")
    expect(tiles["tiles"] == 4 and tiles["record"]["command"].startswith("synth --levels 1"), tiles)
    expect(about("land.json", "tiles_info.schema.json")["preset"] == "unity", "its JSON file")


def outputs_are_made_again(case):
    """--same-as gives the same bytes in every format, with files of its options and names with spaces; other options go over it."""
    write_dem(case, "a dem.tif", width=100, height=90)
    case.run("stats", "a dem.tif", "--maps", "maps.tif", "-q")
    options = ("-l", 1, "--hurst-map", "maps.tif:1", "--window", "3,4,50,40", "--height-quantum", 0.25)
    os.mkdir(case.path("elsewhere"))
    for ending in ("exr", "tif", "raw", "r16", "png"):
        case.run("synth", "a dem.tif", *options, "-q", "-o", f"a.{ending}")
        said = case.run("synth", "--same-as", f"a.{ending}", "-t", 1, "-o", f"elsewhere/b.{ending}").err
        expect("byte for byte" in said, said)
        with open(case.path(f"a.{ending}"), "rb") as one, open(case.path(f"elsewhere/b.{ending}"), "rb") as other:
            expect(one.read() == other.read(), ending)
    case.run("synth", "--same-as", "a.exr", "--seed", 9, "-q", "-o", "c.exr")
    command = json.loads(case.run("info", "--json", "c.exr").out)["parameters"]["command"]
    expect(command == 'synth --levels 1 --seed 9 --hurst-map maps.tif:1 --window 3,4,50,40 --height-quantum 0.25 "a dem.tif"', command)
    case.run("synth", "--same-as", "c.exr", "--seed", 0, "-q", "-o", "d.exr")
    with open(case.path("a.exr"), "rb") as one, open(case.path("d.exr"), "rb") as other:
        expect(one.read() == other.read(), "the default over the record")
    itself = case.run("synth", "--same-as", "a.exr", "-o", "a.exr", "--overwrite", status=2).err
    expect("name another output" in itself, itself)
    with open(case.path("a.raw.json"), encoding="utf-8") as file:
        about = json.load(file)
    for wrong in ("-o c.tif --overwrite", "--overwrite", "--output=c.tif", "--same-as a.exr", "-q"):
        about["parameters"]["command"] = f'synth {wrong} --levels 1 "a dem.tif"'
        with open(case.path("a.raw.json"), "w", encoding="utf-8") as file:
            json.dump(about, file)
        refused = case.run("synth", "--same-as", "a.raw", "-o", "g.exr", status=2).err
        expect("does not record" in refused, refused)
    write_dem(case, "a dem.tif", width=101, height=90)
    refused = case.run("synth", "--same-as", "a.exr", "-q", "-o", "e.exr", status=1).err
    expect("not kept" in refused, refused)
    case.run("synth", "a dem.tif", "-l", 1, "--layers", "normal,slope", "-q", "-o", "layered.exr")
    write_dem(case, "a dem.tif", width=102, height=90)
    before = set(os.listdir(case.folder))
    case.run("synth", "--same-as", "layered.exr", "-q", "-o", "e.exr", status=1)
    expect(set(os.listdir(case.folder)) == before, "layers are left behind")
    expect("was made by talus synth" in case.run("noise", "--same-as", "a.exr", "-o", "f.exr", status=2).err, "the command")
    os.unlink(case.path("a dem.tif"))
    expect("name the input too" in case.run("synth", "--same-as", "a.exr", "-o", "f.exr", status=2).err, "a lost input")


def png_within_half_a_step(case):
    write_dem(case, holes=True)
    for dem in (EXAMPLE, "dem.tif"):
        case.run("synth", dem, "-l", 0, "-q", "--overwrite", "--compression", "none", "-o", "a.exr")
        case.run("synth", dem, "-l", 0, "-q", "--overwrite", "-o", "a.png")
        truth, picture = read_exr(case.path("a.exr")), read_png16(case.path("a.png"))
        with open(case.path("a.json"), encoding="utf-8") as file:
            about = json.load(file)
        expect((picture.width, picture.height) == (about["width"], about["height"]) == (truth.width, truth.height), "size")
        # half a step, and the rounding of the double arithmetic on both sides
        limit = about["scale"] / 2 * (1 + 1e-9) + 1e-12 * max(abs(about["lowest"]), abs(about["highest"]))
        for value, height in zip(picture.values, truth.values):
            if math.isnan(height):
                expect(value == about["void"], f"a void is {value}")
            else:
                expect(abs(about["offset"] + about["scale"] * value - height) <= limit, f"{value} for {height}")
                expect(value != about["void"], "a height is marked void")
        expect(max(picture.values) == 65535, "the range is not used")
        valid = [z for z in truth.values if not math.isnan(z)]
        expect((min(valid), max(valid)) == (about["lowest"], about["highest"]), "the sidecar's range")


def expect_samples_kept(dem, width, height, made, step):
    expect((made.width, made.height) == ((width - 1) * step + 1, (height - 1) * step + 1), "size")
    for row in range(height):
        found = made.values[row * step * made.width:row * step * made.width + made.width:step]
        want = dem[row * width:(row + 1) * width]
        expect(all(map(same, found, want)), f"row {row} differs from the DEM's")


def point_samples_are_kept(case):
    dem = write_dem(case, point=True)
    for levels in (0, 1, 3):
        for scheme in ("stationary", "square"):
            case.run("synth", "dem.tif", "-l", levels, "--scheme", scheme, "--compression", "none", "--overwrite", "-q",
                     "-o", "a.exr")
            expect_samples_kept(dem, 70, 50, read_exr(case.path("a.exr")), 2 ** levels)


def point_samples_of_the_andes_are_kept(case):
    path = shared("dem", "nfong_S33W071.tif")
    dem = read_tiff(path)
    case.run("synth", path, "-l", 1, "--compression", "none", "-q", "-o", "a.exr")
    expect_samples_kept(array.array("f", dem.values), dem.width, dem.height, read_exr(case.path("a.exr")), 2)


def area_means_stay_on_their_footprint(case):
    """An area raster W x H becomes W 2^l x H 2^l cells; gdalinfo judges the place elsewhere."""
    write_dem(case, point=False)
    case.run("synth", "dem.tif", "-l", 2, "--compression", "none", "-q", "-o", "a.tif")
    made = read_tiff(case.path("a.tif"))
    expect((made.width, made.height) == (280, 200), "size")
    expect(made.about[33550][:2] == (7.5, 7.5) and made.about[33922] == (0, 0, 0, 400000, 3800000, 0), f"{made.about}")


# ---- meshes ----

def radius_of_parallel(latitude):
    """Metres from the axis of GRS 80's ellipsoid, latitude in degrees."""
    flattening, phi = 1 / 298.257222101, math.radians(latitude)
    return 6378137 * math.cos(phi) / math.sqrt(1 - flattening * (2 - flattening) * math.sin(phi) ** 2)


def spans(mesh):
    return [max(mesh.positions[k::3]) - min(mesh.positions[k::3]) for k in range(3)]


def faces_down(mesh, up):
    """The number of triangles whose normal does not point along the axis `up`."""
    a, b = [(1, 2), (2, 0), (0, 1)][up]
    wrong, p = 0, mesh.positions
    for t in range(0, len(mesh.indices), 3):
        i, j, k = (3 * n for n in mesh.indices[t:t + 3])
        area = (p[j + a] - p[i + a]) * (p[k + b] - p[i + b]) - (p[j + b] - p[i + b]) * (p[k + a] - p[i + a])
        wrong += area <= 0
    return wrong


def glb_is_in_metres(case):
    case.run("synth", EXAMPLE, "-l", 0, "-q", "-o", "a.glb")
    mesh = read_glb(case.path("a.glb"))
    expect(len(mesh.positions) == 3 * 403 * 344 and len(mesh.indices) == 3 * 2 * 402 * 343, "number of triangles")
    expect(faces_down(mesh, 1) == 0, "triangles that face down")
    # The southern rim is the longest: 402 cells of 1/1200 degree on its parallel, seen from the tangent plane's middle.
    # A chord of 30 km is shorter than its arc by 30^2 / (24 * 6370^2), 1e-6 of it, and the lift of 1 km of height is 1.6e-4.
    east = radius_of_parallel(36.4466666667) * math.radians(402 / 1200)
    expect(abs(spans(mesh)[0] / east - 1) < 2e-4, f"{spans(mesh)[0]} m from west to east, not {east}")
    # from south to north: 343 cells of the meridian, whose radius of curvature at 36.59 degrees is 6,358 km
    north = 6358.1e3 * math.radians(343 / 1200)
    # the corners of the northern rim lie farther north than its middle by the parallel's sagitta, 15 km^2 tan(phi) / 2R
    sagitta = 15.0e3 ** 2 * math.tan(math.radians(36.6)) / (2 * 6.37e6)
    expect(abs(spans(mesh)[2] - north) < 2e-4 * north + sagitta, f"{spans(mesh)[2]} m from south to north, not {north}")


def frames_agree(case):
    """The same mesh in each frame and format; a grid of 30 m cells, 2.1 by 1.5 km, in UTM zone 11."""
    values = write_dem(case, point=True)
    for name, read in (("glb", read_glb), ("ply", read_ply), ("obj", read_obj)):
        meshes = {}
        for frame in ("pixel", "projected", "enu"):
            case.run("synth", "dem.tif", "-l", 0, "-q", "--frame", frame, "-o", f"{frame}.{name}")
            meshes[frame] = read(case.path(f"{frame}.{name}"))
            expect(len(meshes[frame].positions) == 3 * 70 * 50, "vertices")
        upwards = {frame: 1 if name == "glb" and frame == "enu" else 2 for frame in meshes}
        expect(faces_down(meshes["enu"], upwards["enu"]) == 0, f"{name}: enu faces down")
        if name == "glb":
            continue  # its pixel and projected frames are not right-handed with y up; sizes are judged above
        expect(faces_down(meshes["projected"], 2) == 0, f"{name}: projected faces down")
        expect(faces_down(meshes["pixel"], 2) == 0, f"{name}: pixel faces down")
        expect(spans(meshes["pixel"])[:2] == [69, 49], f"{name}: {spans(meshes['pixel'])}")
        expect(spans(meshes["projected"])[:2] == [69 * 30, 49 * 30], f"{name}: {spans(meshes['projected'])}")
        expect(min(meshes["projected"].positions[0::3]) == 400000 and max(meshes["projected"].positions[1::3]) == 3800000,
               f"{name}: corner")
        # metres on the ground: UTM's scale 1.1 degrees from the meridian of zone 11 is 0.9996 (1 + 0.0157^2 / 2), and the
        # grid is turned by 0.6 degrees against east; a diagonal does not see that
        p = meshes["enu"].positions
        index = {}
        for k in range(0, len(p), 3):
            index[(meshes["pixel"].positions[k], meshes["pixel"].positions[k + 1])] = p[k:k + 3]
        a, b = index[(0, 0)], index[(69, 49)]
        ground, grid = math.hypot(a[0] - b[0], a[1] - b[1]), math.hypot(69 * 30, 49 * 30)
        expect(abs(grid / ground - 0.9996 * (1 + 0.0157 ** 2 / 2)) < 1e-4, f"{name}: {ground} m for {grid} m of grid")
        for place, found in zip(range(0, len(p), 3), p[2::3]):
            i, j = (int(n) for n in meshes["pixel"].positions[place:place + 2])
            want = meshes["pixel"].positions[place + 2]
            expect(abs(want - values[j * 70 + i]) < 1e-5, f"{name}: height at {i}, {j}")


def simplify_keeps_its_word(case):
    """The printed error is at most the bound, and near it; fewer triangles for larger bounds."""
    triangles = []
    for bound in (1, 5, 20):
        said = case.run("simplify", EXAMPLE, "-e", bound, "--verify", "--frame", "pixel", "-o", f"{bound}.ply").err
        worst = float(re.search(r"largest error ([\d.e+-]+) at", said).group(1))
        expect(bound / 2 < worst <= bound, said)
        expect("138632 samples, 0 uncovered" in said, said)
        triangles.append(int(re.search(r"(\d+) triangles", said).group(1)))
        mesh = read_ply(case.path(f"{bound}.ply"))
        expect(len(mesh.indices) == 3 * triangles[-1], "another number of triangles")
        expect(faces_down(mesh, 2) == 0, "folded triangles")
        # without overlap or gap, the triangles' areas add up to the grid's
        p, area = mesh.positions, 0
        for t in range(0, len(mesh.indices), 3):
            i, j, k = (3 * n for n in mesh.indices[t:t + 3])
            area += abs((p[j] - p[i]) * (p[k + 1] - p[i + 1]) - (p[j + 1] - p[i + 1]) * (p[k] - p[i])) / 2
        expect(area == 402 * 343, f"area {area}")
    expect(triangles == sorted(triangles, reverse=True), f"{triangles}")


def diagonals_are_turned(case):
    """Squares are cut along the lower diagonal under the same bound; what cannot be turned is refused."""
    said = case.run("simplify", EXAMPLE, "-e", 5, "--diagonal", "lower", "--verify", "--frame", "pixel", "-o", "low.ply").err
    numbers = re.search(r"diagonals: (\d+) squares, (\d+) low already, (\d+) turned, (\d+) held", said)
    squares, low, turned, held = (int(number) for number in numbers.groups())
    expect(low + turned + held == squares and turned > 1000 and held > 100, said)
    expect(float(re.search(r"largest error ([\d.e+-]+) at", said).group(1)) <= 5, said)
    case.run("simplify", EXAMPLE, "-e", 5, "-q", "--frame", "pixel", "-o", "plain.ply")
    low, plain = read_ply(case.path("low.ply")), read_ply(case.path("plain.ply"))
    expect(low.positions == plain.positions and len(low.indices) == len(plain.indices), "vertices changed")
    expect(faces_down(low, 2) == 0, "folded triangles")
    changed = sum(low.indices[t:t + 3] != plain.indices[t:t + 3] for t in range(0, len(low.indices), 3))
    expect(changed == 2 * turned, f"{changed} triangles changed")
    refused = case.run("simplify", EXAMPLE, "-e", 5, "--diagonal", "lower", "--mesh", "tin", "-o", "x.ply", status=2).err
    expect("--diagonal lower is for quadtree meshes" in refused, refused)


def codings_keep_the_bound(case):
    """A GLB in steps of 16 bits, encoded or not, keeps the bound by its own numbers; other formats have no coding."""
    sizes = []
    for coding in ("float", "quantized", "meshopt"):
        said = case.run("simplify", EXAMPLE, "-e", 20, "--coding", coding, "--verify", "-o", f"{coding}.glb").err
        expect(float(re.search(r"largest error ([\d.e+-]+) at", said).group(1)) <= 20, said)
        sizes.append(os.path.getsize(case.path(f"{coding}.glb")))
    expect(sizes[2] < sizes[0] / 2 and sizes[1] < sizes[0], f"{sizes}")
    refused = case.run("simplify", EXAMPLE, "-e", 20, "--coding", "meshopt", "-o", "x.ply", status=2).err
    expect("--coding is for .glb" in refused, refused)


def layers_are_written_beside(case):
    """Layers get names of their own, and the size of the heights; unknown ones are refused before the work."""
    case.run("synth", EXAMPLE, "--window", "0,0,40,30", "-l", 2, "--layers", "normal,splat,slope", "-q", "-o", "t.exr")
    expect("160 x 120" in case.run("info", "t.slope.exr").out, "size of the slope")
    for kind in ("normal", "splat", "slope"):
        expect(os.path.getsize(case.path(f"t.{kind}.exr")) > 5000, kind)
    case.run("synth", EXAMPLE, "--window", "0,0,40,30", "-l", 2, "--layers", "colour", "--layer-format", "png", "-q", "-o", "u.exr")
    with open(case.path("u.colour.png"), "rb") as file:
        head = file.read(24)
    expect(head[1:4] == b"PNG" and struct.unpack(">II", head[16:24]) == (160, 120), f"{head}")
    refused = case.run("synth", EXAMPLE, "--layers", "normal,gloss", "-o", "v.exr", status=2).err
    expect("gloss" in refused and "curvature" in refused, refused)
    expect(not os.path.exists(case.path("v.exr")), "work was done")


def vertices_tell_where_they_came_from(case):
    """With --morph the attribute is the height plus the way of the morph target upwards; some move, by no more than the relief."""
    case.run("view", EXAMPLE, "--eye", "-84.25,36.55,300", "--above-ground", "--heading", 120, "-l", 1, "--frame", "pixel",
             "--morph", "-q", "-o", "m.glb")
    with open(case.path("m.glb"), "rb") as file:
        data = file.read()
    size = struct.unpack_from("<I", data, 12)[0]
    about, binary = json.loads(data[20:20 + size]), data[28 + size:]
    primitive = about["meshes"][0]["primitives"][0]

    def values(index, width):
        a = about["accessors"][index]
        v = about["bufferViews"][a["bufferView"]]
        start = v.get("byteOffset", 0) + a.get("byteOffset", 0)
        return [struct.unpack_from(f"<{width}f", binary, start + k * v["byteStride"]) for k in range(a["count"])]

    at, by = values(primitive["attributes"]["POSITION"], 3), values(primitive["targets"][0]["POSITION"], 3)
    parent = values(primitive["attributes"]["_PARENT_HEIGHT"], 1)
    expect(len(at) == len(by) == len(parent) > 1000, f"{len(at)} {len(by)} {len(parent)}")
    moved = 0
    for position, way, height in zip(at, by, parent):
        expect(abs(position[1] + way[1] - height[0]) < 1e-3 and way[0] == way[2] == 0, f"{position} {way} {height}")
        moved += way[1] != 0
    expect(moved > len(at) / 2 and max(abs(way[1]) for way in by) < 900, f"{moved} of {len(at)} move")
    refused = case.run("view", EXAMPLE, "--eye", "-84.25,36.55,300", "--morph", "-o", "m.ply", status=2).err
    expect("--morph is for a .glb" in refused, refused)


def flights_tell_how_far_ground_jumps(case):
    """fly --measure has a column more; with --geomorph the ground jumps less; an eye under the ground is told, once."""
    with open(case.path("path.json"), "w", encoding="utf-8") as file:
        json.dump({"width": 240, "height": 160, "heading": 120, "pitch": -5,
                   "views": [{"eye": [-84.25, 36.55, 900]}, {"eye": [-84.2499, 36.5499, 900]}]}, file)
    largest = []
    for more in ((), ("--geomorph",)):
        rows = case.run("fly", EXAMPLE, "--path", "path.json", "--frames", 5, "-l", 4, "--measure", "--csv", "-q", *more).out.split()
        expect(rows[0].endswith(",seconds,shift") and len(rows) == 6, f"{rows}")
        largest.append(max(float(row.split(",")[-1]) for row in rows[1:]))
    expect(0 < largest[1] < largest[0] / 2 and largest[1] < 1, f"{largest}")
    case.run("fly", EXAMPLE, "--path", "path.json", "--frames", 2, "-l", 2, "--texture", "colour", "--texture-size", 256, "-o", "f%d.glb")
    case.run("view", EXAMPLE, "--eye", "-84.25,36.55,900", "--viewport", "240x160", "--heading", 120, "--pitch", -5, "-l", 2, "--texture", "colour",
             "--texture-size", 256, "-o", "same.glb")
    with open(case.path("f0.glb"), "rb") as frame, open(case.path("same.glb"), "rb") as view:
        first, other = frame.read(), view.read()
    expect(first.count(b"image/png") == other.count(b"image/png") > 0, f"{first.count(b'image/png')}, {other.count(b'image/png')} textures")
    case.run("fly", EXAMPLE, "--path", "path.json", "--texture", "colour", "-o", "g%d.ply", status=2)
    with open(case.path("deep.json"), "w", encoding="utf-8") as file:
        json.dump({"views": [{"eye": [-84.25, 36.55, -900]}, {"eye": [-84.2499, 36.5499, -900]}]}, file)
    said = case.run("fly", EXAMPLE, "--path", "deep.json", "--frames", 3).err
    expect(said.count("under the ground") == 1, said)
    said = case.run("view", EXAMPLE, "--eye", "-84.25,36.55,-900", "-o", "v.glb").err
    expect(said.count("under the ground") == 1, said)
    said = case.run("view", EXAMPLE, "--eye", "-84.25,36.55,900", "--distance-bands", "9", "--geomorph", "-o", "w.glb", status=2).err
    expect("--geomorph" in said, said)


def pictures_take_colours_of_rasters(case):
    """A raster (of heights here, cut to bytes) colours the ground; hypsometric is the default."""
    view = ("view", EXAMPLE, "--eye", "-84.25,36.55,2000", "--pitch", -60, "-l", 1, "--viewport", "320x200", "-q")
    case.run(*view, "--picture", "plain.png")
    case.run(*view, "--picture", "draped.png", "--colour", EXAMPLE)
    expect(open(case.path("plain.png"), "rb").read() != open(case.path("draped.png"), "rb").read(), "no colour came")
    case.run(*view, "--picture", "same.png", "--colour", "hypsometric")
    expect(open(case.path("plain.png"), "rb").read() == open(case.path("same.png"), "rb").read(), "colours by height differ")
    said = case.run(*view, "--picture", "a.png", "--colour", EXAMPLE, "--grey", status=2).err
    expect("--grey" in said, said)
    said = case.run(*view, "--picture", "a.png", "--colour", "none.tif", status=1).err
    expect("none.tif" in said and not os.path.exists(case.path("a.png")), said)
    small = ("preview", EXAMPLE, "--width", 200, "--height", 120, "-q")
    for k, more in enumerate([(), ("--colour", "hypsometric"), ("--colour", EXAMPLE), ("--colour", "splat")]):
        case.run(*small, "--perspective", *more, "-o", f"p{k}.png")
    p = [open(case.path(f"p{k}.png"), "rb").read() for k in range(4)]
    expect(p[0] == p[1] and len(set(p)) == 3, "colours of perspectives")
    expect("--perspective" in case.run(*small, "--colour", "splat", "-o", "q.png", status=2).err, "a hillshade took colours")


def inputs_are_not_overwritten(case):
    """An output that is an input too, by whatever name, is refused even with --overwrite, and the input stays."""
    with open(EXAMPLE, "rb") as example, open(case.path("dem.tif"), "wb") as copy:
        copy.write(example.read())
    os.symlink("dem.tif", case.path("alias.tif"))
    before = open(case.path("dem.tif"), "rb").read()
    for name in ("dem.tif", "./dem.tif", "alias.tif"):
        said = case.run("synth", "dem.tif", "-l", 0, "-o", name, "--overwrite", status=1).err
        expect("is the input too" in said, said)
    expect(open(case.path("dem.tif"), "rb").read() == before, "the input changed")


def layers_are_refused_before_the_work(case):
    """A layer that cannot be, or whose file is there, leaves no heights behind."""
    said = case.run("synth", EXAMPLE, "-l", 1, "--layers", "slope,sigma", "-o", "t.exr", status=1).err
    expect("--support point" in said, said)
    with open(case.path("u.slope.exr"), "w", encoding="utf-8") as file:
        file.write("mine")
    said = case.run("synth", EXAMPLE, "-l", 1, "--layers", "slope", "-o", "u.exr", status=1).err
    expect("u.slope.exr: exists already" in said, said)
    expect(sorted(os.listdir(case.path("."))) == ["u.slope.exr"], f"{os.listdir(case.path('.'))}")


# ---- the manuals ----

def ask(port, path, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request(method, path, body=b"x" * 70000 if method == "POST" else None, headers=headers)
    answer = connection.getresponse()
    found = (answer.status, answer.getheader("Content-Encoding"), answer.read())
    connection.close()
    return found


def serves_the_folder_alone(case):
    """serve gives files of the folder to this machine: nothing beside it, by dots or links, and nothing to pages of other sites."""
    os.makedirs(case.path("site/0"))
    for name, text in (("site/layer.json", "{}"), ("site/0/0.terrain", "packed"), ("secret", "no"), ("site2", "no")):
        with open(case.path(name), "w", encoding="ascii") as file:
            file.write(text)
    os.symlink(case.path("secret"), case.path("site/link"))
    os.symlink("layer.json", case.path("site/inner"))
    server = subprocess.Popen([case.program, "serve", "site", "--port", "0"], cwd=case.folder, stdout=subprocess.PIPE,
                              stderr=subprocess.DEVNULL)
    try:
        first = server.stdout.readline().decode()
        if not first:
            raise Skip("built without libmicrohttpd")
        port = int(re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\n", first).group(1))
        expect(ask(port, "/layer.json") == (200, None, b"{}"), "a file")
        expect(ask(port, "/inner") == (200, None, b"{}"), "a link within the folder")
        expect(ask(port, "/0/0.terrain") == (200, "gzip", b"packed"), "a tile")
        expect(ask(port, "/layer.json", "HEAD") == (200, None, b""), "HEAD")
        for path in ("/../secret", "/..%2fsecret", "/0/../../secret", "/link", "/0", "/" + "a" * 5000, "/../site2"):
            expect(ask(port, path)[0] == 404, f"{path}: {ask(port, path)}")
        expect(ask(port, "/layer.json", "POST")[0] == 405, "POST")
        expect(ask(port, "/layer.json", Host="example.org")[0] == 403, "another name for this machine")
        server.send_signal(signal.SIGTERM)
        expect(server.wait(20) == 0, "ended by a signal")
    finally:
        server.kill()
        server.wait()
        server.stdout.close()
    expect("no such folder" in case.run("serve", "absent", status=1).err, "a folder that is not there")


def commands_in_readme():
    with open(os.path.join(ROOT, "README.md"), encoding="utf-8") as file:
        text = file.read()
    found = re.findall(r"`(talus [^`\n]+)`", text) + re.findall(r"^(talus [^#\n]+)", text, flags=re.M)
    return [line.strip() for line in found if not re.search(r"[A-Z]{4}", line)]


def commands_in_help(case):
    found = re.findall(r"^Try: (talus .*)$", case.run("help").out, flags=re.M)
    for name in ("info", "simplify", "synth", "preview", "noise", "view"):
        found += re.findall(r"^(?:Examples?:| +) (talus .*)$", case.run("help", name).out, flags=re.M)
    return found


def manuals_show_what_works(case):
    """Every command line of the README and of the help texts, in a folder with the example as dem.tif."""
    with open(EXAMPLE, "rb") as example, open(case.path("dem.tif"), "wb") as copy:
        copy.write(example.read())
    case.run("synth", "dem.tif", "-l", 1, "-q", "-o", "terrain.exr")
    lines = commands_in_readme() + commands_in_help(case)
    expect(len(lines) >= 9, f"{lines}")
    for line in lines:
        words = re.sub(r"--levels \d+", "--levels 1", line).split()[1:]  # the same, in less time
        if words[0] == "synth" and not {"--levels", "-l", "--same-as"} & set(words):
            words += ["--levels", "1"]
        if words[0] == "report":  # reports_keep_their_schema looks at the others
            words += ["--sections", "stability"]
        if "-o" in words:
            replace = [] if words[0] == "tiles" else ["--overwrite"]  # a pyramid wants an empty folder
            expect(case.start(*words, "-q", *replace, stderr=subprocess.DEVNULL).wait(120) == 0, line)
        else:
            case.run(*words, *(["--overwrite"] if "--picture" in words else []))


def commands(case):
    """The commands' names, and the long options of each."""
    names = [name for name in re.findall(r"^  (\w+) ", case.run("help").out, flags=re.M) if name not in ("help", "version", "completions")]
    return {name: re.findall(r"^ +(?:-\w, )?--([\w-]+)", case.run("help", name).out, flags=re.M) for name in names}


def manual(name):
    with open(os.path.join(ROOT, "doc", f"{name}.1.scd"), encoding="utf-8") as file:
        return file.read()


def manuals_and_help_agree(case):
    """Every option is in the pages of its command, and every option that a page or the README names is some command's."""
    known = commands(case)
    expect(len(known) == 11 and all(known.values()), f"{known}")
    common = manual("talus")
    every = {option for options in known.values() for option in options} | {"help", "version"}
    for option in re.findall(r"\*--([a-z][\w-]*)\*", common):
        expect(option in every, f"--{option} of talus(1) is no command's")
    for name, options in known.items():
        page = manual(f"talus-{name}")
        expect(f"*talus {name}*" in common and f"*talus-{name}*(1)" in common, f"{name} is not in talus(1)")
        expect(f"*talus {name}*" in page, f"{name} has no synopsis")
        for option in options:
            expect(f"--{option}*" in common + page, f"--{option} of {name} is not in its pages")
        for option in re.findall(r"\*--([a-z][\w-]*)\*", page):
            expect(option in every, f"--{option} of talus-{name}(1) is no command's")
    for line in commands_in_readme():
        name = line.split()[1]
        for option in re.findall(r" --([a-z][\w-]*)", line):
            expect(option in known.get(name, []), f"--{option} is no option of talus {name}: {line}")


def completions_are_those_of_the_help(case):
    """bash completes commands, options and values; zsh and fish, where they are, read what is made for them."""
    known = commands(case)
    for shell in ("bash", "zsh", "fish"):
        with open(case.path(shell), "w", encoding="utf-8") as file:
            file.write(case.run("completions", shell).out)
        if shutil.which(shell):
            subprocess.run([shell, "-n", case.path(shell)], check=True)
    with open(case.path("fish"), encoding="utf-8") as file:
        fish = file.read()
    for name, options in known.items():
        for option in options:
            expect(f"from {name}' -l {option} " in fish, f"--{option} of {name}")

    def complete(*words):
        script = f'. {case.path("bash")}; compopt() {{ :; }}; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _talus; echo "${{COMPREPLY[@]}}"'
        return subprocess.run(["bash", "-c", script, "bash", *words], check=True, capture_output=True, text=True).stdout.split()

    expect(complete("talus", "sy") == ["synth"], f"{complete('talus', 'sy')}")
    expect(set(complete("talus", "")) == set(known) | {"help", "version", "completions"}, f"{complete('talus', '')}")
    for name, options in known.items():
        expect(set(complete("talus", name, "--")) == {f"--{option}" for option in options} | {"--help"}, name)
    expect(complete("talus", "tiles", "--format", "quant") == ["quantized-mesh"], "--format")
    expect(complete("talus", "tiles", "--format", "=", "3d") == ["3dtiles"], "--format=")
    expect(complete("talus", "synth", "--levels", "") == [], "a number")
    case.run("completions", status=2)
    case.run("completions", "tcsh", status=2)


# ---- tiles ----

def torn_tiles(folder):
    return [name for name in snapshot(folder) if name.endswith(".terrain") and not is_gzip(os.path.join(folder, name))]


def is_gzip(path):
    """Whether a file is one whole gzip stream: its checksum is at its end."""
    try:
        with gzip.open(path) as file:
            return len(file.read()) > 88
    except (OSError, EOFError):
        return False


def tiles_survive_kills(case):
    """Killed at some moments, and gone on with; a run of its own has made what comes out."""
    words = ("tiles", EXAMPLE, "-e", 5, "-l", "8..12", "-q")
    started = time.monotonic()
    case.run(*words, "-o", "whole")
    seconds = time.monotonic() - started
    for share in (0.1, 0.5, 0.9):
        for again in (1, 0.5):
            process = case.start(*words, "--resume", "-o", "killed")
            time.sleep(share * again * seconds)
            process.kill()
            process.communicate()
            if os.path.exists(case.path("killed")):
                expect(not torn_tiles(case.path("killed")), f"{share}: {torn_tiles(case.path('killed'))}")
        case.run(*words, "--resume", "-o", "killed")
        expect(snapshot(case.path("killed")) == snapshot(case.path("whole")), f"killed after {share}: another tree")
        shutil.rmtree(case.path("killed"))


def tiles_go_on_after_an_interruption(case):
    words = ("tiles", EXAMPLE, "-e", 5, "-l", "8..13")
    case.run(*words, "-q", "-o", "whole")
    for number in (signal.SIGINT, signal.SIGTERM):
        process = case.start(*words, "--progress", "json", "-o", "stopped", preexec_fn=default_signals)
        process.stderr.readline()
        process.stderr.readline()
        process.send_signal(number)
        _, said = process.communicate(timeout=120)
        expect(process.returncode in (0, 130), f"exit status {process.returncode}")
        if process.returncode:
            expect(said.decode().endswith("talus: interrupted\n"), said)
            case.run(*words, "-q", "--resume", "-o", "stopped")
        expect(snapshot(case.path("stopped")) == snapshot(case.path("whole")), "another tree")
        shutil.rmtree(case.path("stopped"))


def tiles_tell_a_full_disk(case):
    """One line, and what is there can be gone on with."""
    words = ("tiles", EXAMPLE, "-e", 5, "-l", "9..12", "-q")
    case.run(*words, "-o", "whole")
    size = sum(os.path.getsize(os.path.join(where, name)) for where, _, names in os.walk(case.path("whole")) for name in names)
    for share in (0.01, 0.4, 0.8):
        _, said = mounted_run(case, int(size * share) // 4096 * 4096 + 4096, *words, "-o", "made")
        expect(re.fullmatch(r"talus: made[^:\n]*: cannot (write|make): No space left on device\n", said), said)


def tiles_by_parts_are_the_same(case):
    """By hand, under GNU parallel and under Open MPI, where these are installed."""
    words = ("tiles", EXAMPLE, "-e", 5, "-l", "12..14", "-q", "-t", 1)
    case.run(*words, "-o", "whole")
    whole = snapshot(case.path("whole"))
    program = [case.program, *map(str, words)]
    runs = {"hand": [[*program, "-o", "made", "--shard", f"{k}/3"] for k in (2, 0, 1)]}
    if shutil.which("parallel"):
        runs["parallel"] = [["parallel", "-j", "2", *program, "-o", "made", "--shard", "{}", ":::", "0/2", "1/2"]]
    if shutil.which("mpirun"):
        root = ["--allow-run-as-root"] if os.getuid() == 0 else []
        runs["mpirun"] = [["mpirun", *root, "--oversubscribe", "-n", "2", *program, "-o", "made", "--shard", "auto"]]
    for name, commands in runs.items():
        for command in commands:
            done = subprocess.run(command, cwd=case.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=120,
                                  check=False)
            expect(done.returncode == 0, f"{name}: {done.stdout.decode()}")
        case.run(*words, "--finish", "-o", "made")
        expect(snapshot(case.path("made")) == whole, f"{name}: another tree")
        shutil.rmtree(case.path("made"))


# ---- memory ----

def memory_does_not_grow_with_the_output(case):
    """The output grows fourfold, by 27 or 106 MB; memory may grow by the longer rows of tiles that are in work, not by the
    heights: a quarter of the growth is far above the first and far below the second."""
    if is_sanitized(case.program):
        raise Skip("a sanitizer's memory is its own")
    for name, kind, finest in (("exr", "none", 4), ("tif", "none", 4), ("png", "none", 3)):
        peaks, sizes = [], []
        for levels in (finest - 1, finest):
            peaks.append(case.peak_memory("synth", EXAMPLE, "-l", levels, "--compression", kind, "--threads", 2,
                                          "--overwrite", "-o", f"a.{name}"))
            sizes.append(4 * 403 * 344 * 4 ** levels)
            os.remove(case.path(f"a.{name}"))
        expect(peaks[1] - peaks[0] < (sizes[1] - sizes[0]) / 4, f"{name} {kind}: peaks {peaks} for {sizes} bytes of heights")
        expect(peaks[1] < 512 << 20, f"{name} {kind}: {peaks[1] >> 20} MiB")


def memory_stays_within_what_is_given(case):
    """A raster of 67 MB of heights in 64 MB, and what does not fit is told before it is tried."""
    if is_sanitized(case.program):
        raise Skip("a sanitizer's memory is its own")
    case.run("noise", "-n", 4096, "-q", "--compression", "none", "-o", "large.tif")
    for words in (("info", "large.tif"), ("preview", "large.tif", "-o", "a.png"),
                  ("synth", "large.tif", "-l", 0, "--compression", "none", "-o", "a.exr"),
                  ("synth", "large.tif", "-l", 0, "--compression", "none", "-o", "a.tif"),
                  ("synth", "large.tif", "-l", 1, "--window", "1000,1000,1024,1024", "-o", "b.tif"),
                  ("tiles", "large.tif", "-f", "exr", "-o", "tiles")):
        peak = case.peak_memory(*words, "--memory", 64, "-q")
        expect(peak < 64 << 20, f"{words[0]}: {peak / 1e6:.1f} MB")
    for words in (("synth", "large.tif", "-l", 0, "-o", "a.glb"), ("preview", "large.tif", "-p", "-o", "b.png")):
        told = case.run(*words, "--memory", 64, status=1).err
        missing = int(re.search(r"raise --memory by (\d+) MB", told).group(1))
        if words[0] == "preview":
            case.run(*words, "--memory", 64 + missing, "-q")
    for kind in ("quantized-mesh", "3dtiles"):
        words = ("tiles", EXAMPLE, "-f", kind, "-o", f"site-{kind}", "-t", 2)
        told = case.run(*words, "--memory", 64, status=1).err
        enough = 64 + int(re.search(r"raise --memory by (\d+) MB", told).group(1))
        expect(not os.path.exists(case.path(f"site-{kind}")), f"{kind}: begun without memory")
        peak = case.peak_memory(*words, "--memory", enough, "-q")
        expect(peak < enough << 20, f"{kind}: {peak / 1e6:.1f} MB of {enough} MiB")


# ---- bad input ----

def bad_files_end_with_one_line(case):
    """Every malformed TIFF of the collection: an answer or one line, no crash; what is too long to read can be stopped."""
    folder = os.path.dirname(shared("bad", "INDEX.tsv"))
    for name in sorted(os.listdir(folder)):
        if not name.lower().endswith((".tif", ".tiff")):
            continue
        process = case.start("info", os.path.join(folder, name), "-t", 1)
        try:
            out, err = process.communicate(timeout=5)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=20)
            expect(process.returncode == 130, f"{name}: SIGINT: exit status {process.returncode}")
        expect(process.returncode in (0, 1, 130), f"{name}: exit status {process.returncode}: {err}")
        if process.returncode == 1:
            expect(out == b"" and err.startswith(b"talus: ") and err.count(b"\n") == 1, f"{name}: {out}{err}")
            expect(not re.search(rb"[^\x20-\x7e\n]", err), f"{name}: {err}")
        expect(b"Sanitizer" not in err and b"runtime error" not in err, f"{name}: {err}")


# ---- other eyes ----

def gdal(case, *words):
    found = subprocess.run([tool(words[0]), *words[1:]], cwd=case.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                           timeout=120, check=False)
    expect(found.returncode == 0, found.stderr.decode())
    return found.stdout.decode()


def gdal_reads_the_geotiff(case):
    tool("gdalinfo")
    for point in (False, True):
        write_dem(case, point=point, holes=True)
        for levels in (0, 2):
            command = ("synth", "dem.tif", "-l", levels, "-q", "--overwrite")
            case.run(*command, "-o", "a.tif")
            case.run(*command, "--compression", "none", "-o", "a.exr")
            about = json.loads(gdal(case, "gdalinfo", "-json", "a.tif"))
            cell = 30 / 2 ** levels
            # a point is the middle of GDAL's pixel: its raster begins half a pixel before the first sample
            west, north = (400000 - cell / 2, 3800000 + cell / 2) if point else (400000, 3800000)
            expect(about["geoTransform"] == [west, cell, 0, north, 0, -cell], f"{about['geoTransform']}")
            expect(about["metadata"][""]["AREA_OR_POINT"] == ("Point" if point else "Area"), f"{about['metadata']}")
            expect('ID["EPSG",32611]' in about["coordinateSystem"]["wkt"], "CRS")
            expect(about["bands"][0]["noDataValue"] == "NaN" or math.isnan(float(about["bands"][0]["noDataValue"])),
                   "nodata")
            gdal(case, "gdal_translate", "-q", "-of", "ENVI", "a.tif", "raw")
            raw = array.array("f")
            with open(case.path("raw"), "rb") as file:
                raw.frombytes(file.read())
            truth = read_exr(case.path("a.exr"))
            expect(len(raw) == len(truth.values) and all(map(same, raw, truth.values)), "values")


def gdal_places_the_example(case):
    """Rows from south to north: the matrix of the transformation, not tie point and scale."""
    tool("gdalinfo")
    case.run("synth", EXAMPLE, "-l", 2, "-q", "-o", "a.tif")
    before = json.loads(gdal(case, "gdalinfo", "-json", EXAMPLE))
    after = json.loads(gdal(case, "gdalinfo", "-json", "a.tif"))
    for corner, place in before["cornerCoordinates"].items():
        for a, b in zip(place, after["cornerCoordinates"][corner]):
            expect(abs(a - b) < 1e-9, f"{corner}: {place} became {after['cornerCoordinates'][corner]}")
    expect(before["coordinateSystem"]["wkt"] == after["coordinateSystem"]["wkt"], "CRS")


def openexr_reads_the_exr(case):
    header = tool("exrheader")
    write_dem(case)
    for kind in ("none", "zip", "zips", "piz"):
        case.run("synth", "dem.tif", "-l", 3, "--compression", kind, "-q", "--overwrite", "-o", "a.exr")
        said = subprocess.run([header, "a.exr"], cwd=case.folder, stdout=subprocess.PIPE, check=True).stdout.decode()
        for line in ("Y, 32-bit floating-point", "(0 0) - (559 399)", "tile size 256 by 256", 'gdal:AREA_OR_POINT (type string): "Area"',
                     'talus:levels (type string): "3"'):
            expect(line in said, f"{kind}: no '{line}' in {said}")


def openimageio_agrees_on_the_range(case):
    oiiotool = tool("oiiotool")
    write_dem(case)
    case.run("synth", "dem.tif", "-l", 3, "--compression", "none", "-q", "-o", "none.exr")
    truth = read_exr(case.path("none.exr")).values
    for kind in ("none", "zip", "zips", "piz"):
        case.run("synth", "dem.tif", "-l", 3, "--compression", kind, "-q", "--overwrite", "-o", "a.exr")
        said = subprocess.run([oiiotool, "--stats", "a.exr"], cwd=case.folder, stdout=subprocess.PIPE,
                              check=True).stdout.decode()
        for word, value in (("Min", min(truth)), ("Max", max(truth))):
            found = float(re.search(rf"Stats {word}: ([\d.eE+-]+)", said).group(1))
            expect(abs(found - value) <= 1e-6, f"{kind}: {word} {found}, not {value}")


# ---- the table ----

def with_name(function):
    words = function.__name__.split("_")
    function.name = words[0] + "".join(word.capitalize() for word in words[1:])
    return function


TESTS = [
    *(equal_bytes(name, "synth", EXAMPLE, "--levels", 2 if name in ("exr", "tif") else 1) for name in ("exr", "tif", "png")),
    *(equal_bytes(name, "synth", EXAMPLE, "--levels", 0) for name in ("glb", "obj", "ply")),
    *(equal_bytes(name, "noise", "--size", 300, "--seed", 9) for name in ("exr", "tif", "glb")),
    *(equal_bytes(name, "simplify", EXAMPLE, "-e", 3) for name in ("glb", "obj", "ply")),
    equal_bytes_without_fma, pinned_heights, previews_are_equal_for_any_threads,
    *(interrupted(name, number) for name in ("exr", "tif", "png") for number in (signal.SIGINT, signal.SIGTERM)),
    leaves_nothing_when_interrupted_early, leaves_nothing_when_interrupted_twice,
    leaves_nothing_or_all_when_a_mesh_is_interrupted, leaves_nothing_when_killed, leaves_the_old_file_when_interrupted,
    tells_a_file_size_limit, tells_a_full_disk, tells_an_unwritable_folder, refuses_to_replace,
    follows_the_umask,
    tells_a_full_stdout, tells_a_broken_pipe, closed_streams_do_not_go_into_the_output,
    bar_only_on_a_terminal, progress_lines_are_json, quiet_is_silent,
    json_keeps_its_schema, reports_keep_their_schema, mbtiles_hold_the_folder, statistics_keep_their_schema, real_files_keep_the_schema, window_costs_its_blocks, a_part_is_that_part, corners_agree_with_gdal,
    names_of_any_bytes,
    serves_the_folder_alone, tiles_of_nothing_are_refused, dry_runs_foresee_within_two, formats_hold_the_same_heights, outputs_are_read_back, points_and_tiles_are_read_back, sidecars_are_checked, outputs_are_made_again, png_within_half_a_step, point_samples_are_kept, point_samples_of_the_andes_are_kept,
    area_means_stay_on_their_footprint,
    glb_is_in_metres, frames_agree, simplify_keeps_its_word, diagonals_are_turned, codings_keep_the_bound, layers_are_written_beside, inputs_are_not_overwritten, layers_are_refused_before_the_work, vertices_tell_where_they_came_from,
    flights_tell_how_far_ground_jumps, pictures_take_colours_of_rasters,
    tiles_survive_kills, tiles_go_on_after_an_interruption, tiles_tell_a_full_disk, tiles_by_parts_are_the_same,
    manuals_show_what_works, manuals_and_help_agree, completions_are_those_of_the_help,
    memory_does_not_grow_with_the_output, memory_stays_within_what_is_given, bad_files_end_with_one_line,
    gdal_reads_the_geotiff, gdal_places_the_example, openexr_reads_the_exr, openimageio_agrees_on_the_range,
]


def main():
    names = [word for word in sys.argv[2:] if not word.startswith("-")]
    tests = [test if hasattr(test, "name") else with_name(test) for test in TESTS]
    sys.exit(run_tests(os.path.abspath(sys.argv[1]), [test for test in tests if not names or test.name in names]))


main()

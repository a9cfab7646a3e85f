#!/usr/bin/env python3
"""Faults in every command: faults.py PROGRAM INJECTOR [--whole] [--scope-all] [NAME...]

Each command runs on the example with one fault after the other, injected by inject.c: the k-th allocation fails, alone or with
all behind it; the k-th call of the system fails; reads and writes are shortened and interrupted; the disk is full after N
bytes; a limit on the size of files. Then: folders that cannot be written or vanish, signals at random moments, and a DEM that
is cut or changed while it is read. However it goes,
  - the exit status is 1 with one line on stderr that begins with "talus: ", or 0 with the very bytes of a run without faults;
  - no signal ends the process;
  - what was there before is as it was, and beside it is nothing (but whole tiles and frames, which a later run need not make);
  - talus's own code has freed what it had allocated.
Short (the default): some moments of each command, in less than a minute. --whole: every k up to 300, then ever rarer.
--scope-all fails the allocations of all libraries too. There a death or a silence is told, and excused by one rule: the
allocation that failed was asked for by a library, not by talus. Ends with "N passed, N failed".
"""
import collections
import concurrent.futures
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time

sys.dont_write_bytecode = True
HERE = os.path.dirname(os.path.abspath(__file__))
ROOT = os.path.dirname(os.path.dirname(HERE))
sys.path.insert(0, os.path.join(ROOT, "tests", "cli"))
from harness import EXAMPLE, default_signals, snapshot, text  # noqa: E402

TIMEOUT = 120
PART = ("--window", "40,30,150,110", "-t", "1", "-q")
EYE = ("--eye", "-84.3179,36.5171,6000", "--pitch", "-89", "--viewport", "120x80")

# Name, words, whether its bytes are the same each time, and what may stay after a failure, if it is whole: tiles, frames.
COMMANDS = [
    ("info", ("info", "dem.tif", "--json"), True, None),
    ("simplify-glb", ("simplify", "dem.tif", *PART, "-e", "40", "--texture", "colour", "-o", "a.glb"), True, None),
    ("simplify-tin", ("simplify", "dem.tif", *PART, "-e", "60", "--mesh", "tin", "-o", "a.ply"), True, None),
    ("simplify-points", ("simplify", "dem.tif", *PART, "-e", "40", "--points", "-o", "a.tif"), True, None),
    ("synth-exr", ("synth", "dem.tif", *PART, "-l", "1", "--layers", "normal,splat", "-o", "a.exr"), True, None),
    ("synth-framework", ("synth", "dem.tif", *PART, "-l", "1", "-e", "30", "--verify", "-o", "a.tif"), True, None),
    ("synth-png", ("synth", "dem.tif", *PART, "-l", "0", "-o", "a.png"), True, None),
    ("synth-cog", ("synth", "dem.tif", *PART, "-l", "1", "--cog", "-o", "a.tif"), True, None),
    ("synth-unreal", ("synth", "dem.tif", *PART, "-l", "1", "--preset", "unreal", "-o", "a.png"), True, None),
    ("synth-obj", ("synth", "dem.tif", *PART, "-l", "0", "-o", "a.obj"), True, None),
    ("noise", ("noise", "-n", "64", "-t", "1", "-q", "-o", "a.exr"), True, None),
    ("noise-exact", ("noise", "-n", "64", "--scheme", "exact", "-t", "1", "-q", "-o", "a.r16"), True, None),
    ("preview", ("preview", "dem.tif", *PART, "--height", "60", "-o", "a.png"), True, None),
    ("preview-perspective", ("preview", "dem.tif", *PART, "-p", "--height", "60", "--width", "80", "-o", "a.png"), True, None),
    ("view", ("view", "dem.tif", *EYE, *PART, "-l", "1", "-o", "a.glb", "--picture", "a.png"), True, None),
    ("view-roam", ("view", "dem.tif", *EYE, *PART, "-l", "1", "--lod", "roam", "--budget", "500", "-o", "a.ply"), True, None),
    ("fly", ("fly", "dem.tif", "--path", "path.json", "--frames", "2", *PART, "-l", "1", "-o", "f%02d.ply"), True, r"f\d\d\.ply$"),
    ("stats", ("stats", "dem.tif", *PART, "--json", "-o", "a.svg", "--maps", "m.tif"), True, None),
    ("tiles", ("tiles", "dem.tif", *PART, "-l", "9..11", "-o", "t"), True, "t(/|$)"),
    ("tiles-3d", ("tiles", "dem.tif", *PART, "-f", "3dtiles", "-o", "t"), True, "t(/|$)"),
    ("report", ("report", "dem.tif", "--window", "40,30,64,48", "-t", "1", "-q", "--quick", "--sections", "framework", "-o", "r"),
     False, "r(/|$)"),
    ("serve", ("serve", "site", "--port", "0", "-q"), False, None),
]

PATH = {"width": 120, "height": 80, "heading": 120, "pitch": -89,
        "views": [{"eye": [-84.3179, 36.5171, 6000]}, {"eye": [-84.3178, 36.5171, 6000]}]}


class Fault(Exception):
    """What a run did that it must not."""


class Bench:
    """A command in fresh folders, without faults first."""

    def __init__(self, program, injector, root, row):
        self.program, self.injector, self.root = program, injector, root
        self.name, self.words, self.same, self.keeps = row
        self.results = collections.Counter()

    def fresh(self):
        folder = tempfile.mkdtemp(dir=self.root)
        shutil.copy(EXAMPLE, os.path.join(folder, "dem.tif"))
        with open(os.path.join(folder, "path.json"), "w", encoding="utf-8") as file:
            json.dump(PATH, file)
        if self.name == "serve":
            os.mkdir(os.path.join(folder, "site"))
            with open(os.path.join(folder, "site", "layer.json"), "w", encoding="utf-8") as file:
                file.write("{}")
        return folder

    def start(self, folder, faults, **options):
        environment = os.environ
        if "preexec_fn" not in options:
            environment = {**os.environ, "LD_PRELOAD": self.injector, "FAULT_LOG": folder + ".log", **faults}
        return subprocess.Popen([self.program, *self.words], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                                stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)

    def finish(self, process):
        if self.name == "serve":  # which would go on for ever: its address, and then its end, are all
            first = process.stdout.readline()
            if first:
                process.send_signal(signal.SIGTERM)
        try:
            out, err = process.communicate(timeout=TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            raise Fault("does not end")
        return process.returncode, text(out), text(err)

    def measure(self):
        """The run without faults: its bytes, and how many allocations and calls there are to fail."""
        folder = self.fresh()
        self.before = snapshot(folder)
        started = time.monotonic()
        status, self.out, err = self.finish(self.start(folder, {}))
        self.seconds = time.monotonic() - started
        if status == 1 and "built without" in err:
            return False
        if status != 0:
            raise Fault(f"fails without a fault: {err}")
        self.after = snapshot(folder)
        self.log = read_log(folder + ".log")
        if self.log["leak"]:
            raise Fault(f"leaks without a fault: {self.log['leak']}")
        self.size = sum(os.path.getsize(os.path.join(folder, name)) for name in self.after
                        if name not in self.before and self.after[name] != "folder")
        self.clean(folder)
        return True

    def clean(self, folder):
        shutil.rmtree(folder, ignore_errors=True)
        if os.path.exists(folder + ".log"):
            os.remove(folder + ".log")

    def judge(self, folder, status, out, err, statuses=(0, 1), changed=()):
        if status not in statuses:
            raise Fault(f"ended by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}: {err!r}")
        if status == 1 and not re.fullmatch(r"talus[^\n]*: [^\n]+\n", err):
            raise Fault(f"said not one line: {err!r}")
        now = snapshot(folder)
        for name in changed:  # the DEM that was changed by the test
            now[name] = self.before[name]
        if status != 0:
            self.judge_rest(now)
        elif self.same and not changed and (now, out) != (self.after, self.out):
            names = [name for name in sorted({*now, *self.after}) if now.get(name) != self.after.get(name)]
            raise Fault(f"success, with other bytes: {names or 'stdout'}; {err!r}")
        log = read_log(folder + ".log")
        if log["leak"]:
            raise Fault(f"leaks {log['leak']}")

    def judge_rest(self, now):
        for name in sorted({*now, *self.before}):
            inside = self.keeps and re.match(self.keeps, name)
            if not inside and now.get(name) != self.before.get(name):
                raise Fault(f"left {name}" if name in now else f"took {name} away")
            if inside and name in self.after and self.same and now[name] != self.after[name]:
                raise Fault(f"left {name}, not whole")
            if inside and name not in self.after and ".talus" not in name:
                raise Fault(f"left {name}")

    def run(self, what, faults, **options):
        folder = self.fresh()
        try:
            status, out, err = self.finish(self.start(folder, faults, **options))
            self.judge(folder, status, out, err)
            self.results["survived" if status == 0 else "refused"] += 1
            return None
        except Fault as fault:
            log = read_log(folder + ".log")
            asked = log["failed"]
            if faults.get("FAULT_SCOPE") == "all" and asked and not is_ours(asked[0]):
                self.results["theirs"] += 1
                return None
            return f"{self.name}, {what}: {fault}; at {', '.join(where(a) for a in asked) or '?'}"
        finally:
            self.clean(folder)


def read_log(path):
    found = {"failed": [], "leak": [], "allocations": 0, "calls": 0}
    if os.path.exists(path):
        with open(path, encoding="utf-8") as file:
            for line in file:
                words = line.split()
                if words[0] in ("failed", "leak"):
                    found[words[0]].append(" ".join(words[1:]))
                else:
                    found[words[0]] = int(words[1])
    return found


def is_ours(place):
    return os.path.basename(place.split()[0]).startswith(("talus", "libtalus"))


NAMES = {}


def where(place):
    """The function and line of an address, where the program has such names."""
    if place not in NAMES:
        module, offset = place.rsplit(" ", 1)
        try:
            found = subprocess.run(["addr2line", "-f", "-s", "-e", module, hex(int(offset, 16) - 1)], stdout=subprocess.PIPE,
                                   stderr=subprocess.DEVNULL, check=False).stdout.decode().split("\n")
        except OSError:
            found = ["??"]
        NAMES[place] = f"{os.path.basename(module)} {offset} {' '.join(found).strip()}"
    return NAMES[place]


def moments(count, whole):
    """Which of `count` allocations or calls to fail."""
    if not whole:
        return sorted({1, 2, count} | {1 + count * k // 9 for k in range(9)}) if count else []
    picked = list(range(1, min(count, 300) + 1))
    k = 300.0
    while k * 1.04 < count:
        k *= 1.04
        picked.append(int(k))
    return sorted({*picked, *([count] if count else [])})


def limit(size):
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def jobs_of(bench, whole, scope_all):
    """(what, environment, options of the process) of each run with a fault."""
    if scope_all:
        probe = bench.fresh()
        bench.finish(bench.start(probe, {"FAULT_SCOPE": "all"}))
        count = read_log(probe + ".log")["allocations"]
        bench.clean(probe)
        for k in moments(count, whole):
            yield f"allocation {k} of all {count}", {"FAULT_SCOPE": "all", "FAULT_ALLOC": str(k)}, {}
        return
    count = bench.log["allocations"]
    for k in moments(count, whole):
        yield f"allocation {k} of {count}", {"FAULT_ALLOC": str(k)}, {}
    for k in moments(count, whole)[::4 if whole else 5]:
        yield f"allocations from {k} on", {"FAULT_ALLOC": str(k), "FAULT_LASTING": "1"}, {}
    for k in moments(bench.log["calls"], whole)[:: 1 if whole else 2]:
        yield f"call {k}", {"FAULT_CALL": str(k)}, {}
    for seed in range(10 if whole else 1):
        yield f"short reads and writes {seed}", {"FAULT_SHORT": str(seed)}, {}
    for k in range(12 if whole else 2):
        room = bench.size * k // 12 if whole else bench.size * k // 2
        if room < bench.size:
            yield f"a disk of {room} bytes", {"FAULT_SPACE": str(room)}, {}
            yield f"files of {room} bytes", {}, {"preexec_fn": limit(room)}


# ---- what the world does ----

def closed_folder(bench, _):
    """A folder that cannot be written; root may write any, so it drops to nobody, and where it may not, this is not tested."""
    folder = bench.fresh()
    try:
        if os.geteuid() == 0:
            os.chmod(bench.root, 0o755)
            shutil.chown(folder, "nobody")
        os.chmod(folder, 0o555)

        def nobody():
            if os.geteuid() == 0:
                os.setgid(65534)
                os.setuid(65534)

        if bench.name in ("info", "serve"):
            return
        process = subprocess.Popen([bench.program, *bench.words], cwd=folder, stdin=subprocess.DEVNULL,
                                   stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=nobody)
        status, out, err = bench.finish(process)
        bench.judge(folder, status, out, err, statuses=(1,))
    finally:
        os.chmod(folder, 0o755)
        bench.clean(folder)


def vanishing_folder(bench, delay):
    """The whole folder is taken away, with the DEM and what is being written."""
    folder = bench.fresh()
    process = bench.start(folder, {})
    gone = folder + ".gone"

    def vanish():
        time.sleep(delay * bench.seconds)
        os.rename(folder, gone)
        shutil.rmtree(gone, ignore_errors=True)

    thread = threading.Thread(target=vanish)
    thread.start()
    status, _, err = bench.finish(process)
    thread.join()
    shutil.rmtree(gone, ignore_errors=True)
    bench.clean(folder)
    if status not in (0, 1) or status == 1 and not re.fullmatch(r"talus[^\n]*: [^\n]+\n", err):
        raise Fault(f"exit status {status}: {err!r}")


def signalled(number):
    def test(bench, delay):
        folder = bench.fresh()
        process = bench.start(folder, {}, preexec_fn=default_signals)
        time.sleep(delay * bench.seconds)
        process.send_signal(number)
        status, out, err = bench.finish(process)
        # before the handlers are in place the signal itself ends the process
        bench.judge(folder, status, out, err, statuses=(0, 130, -number))
        if status == 130 and not err.endswith("talus: interrupted\n"):
            raise Fault(f"status 130, and said {err!r}")
        bench.clean(folder)

    test.__name__ = signal.Signals(number).name
    return test


def changing_dem(bench, delay):
    """The DEM is cut, written over with noise, or made whole again, while it is read."""
    folder = bench.fresh()
    dem = os.path.join(folder, "dem.tif")
    chance = random.Random(int(delay * 1e9))
    process = bench.start(folder, {})
    time.sleep(delay * bench.seconds)
    try:
        with open(dem, "r+b") as file:
            if chance.random() < 0.5:
                file.truncate(chance.randrange(os.path.getsize(dem)))
            else:
                file.seek(chance.randrange(os.path.getsize(dem)))
                file.write(chance.getrandbits(8 * 5000).to_bytes(5000, "little"))
        status, out, err = bench.finish(process)
        bench.judge(folder, status, out, err, changed=("dem.tif",))
    finally:
        bench.clean(folder)


WORLD = [closed_folder, vanishing_folder, signalled(signal.SIGINT), signalled(signal.SIGTERM), changing_dem]


def world(bench, test, delay):
    try:
        test(bench, delay)
        bench.results[test.__name__] += 1
        return None
    except Fault as fault:
        return f"{bench.name}, {test.__name__} after {delay:.2f} of its time: {fault}"


def world_jobs(bench, whole, seed):
    chance = random.Random(f"{seed} {bench.name}")
    for test in WORLD:
        times = 1 if test is closed_folder else 8 if whole else 1
        if bench.name == "serve" and test is not closed_folder:
            continue  # goes on until a signal ends it, which ends every run of it above
        for _ in range(times):
            yield test, chance.random()


def run_all(benches, whole, scope_all, seed):
    failures, count = [], 0
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        for bench in benches:
            try:
                if not bench.measure():
                    print(f"[  SKIPPED ] {bench.name}: not built")
                    continue
            except Fault as fault:
                failures.append(f"{bench.name}: {fault}")
                count += 1
                print(failures[-1], flush=True)
                continue
            futures = [pool.submit(bench.run, what, faults, **options)
                       for what, faults, options in jobs_of(bench, whole, scope_all)]
            if not scope_all:
                futures += [pool.submit(world, bench, test, delay) for test, delay in world_jobs(bench, whole, seed)]
            found = [f.result() for f in futures]
            wrong = [line for line in found if line]
            count += len(found)
            failures += wrong
            told = ", ".join(f"{n} {what}" for what, n in bench.results.items())
            print(f"{bench.name}: {len(found)} runs; {told}; {len(wrong)} wrong", flush=True)
            for line in wrong[:40]:
                print("  " + line, flush=True)
    return count, failures


def main():
    options = {word for word in sys.argv[1:] if word.startswith("--")}
    program, injector, *names = [word for word in sys.argv[1:] if not word.startswith("--")]
    seed = os.environ.get("FAULT_SEED") or str(time.time_ns() % 10**6)
    print(f"seed {seed} (FAULT_SEED)")
    root = tempfile.mkdtemp(prefix="talus-faults-")
    try:
        benches = [Bench(os.path.abspath(program), os.path.abspath(injector), root, row) for row in COMMANDS
                   if not names or row[0] in names]
        count, failures = run_all(benches, "--whole" in options, "--scope-all" in options, seed)
    finally:
        shutil.rmtree(root, ignore_errors=True)
    print(f"{count - len(failures)} passed, {len(failures)} failed")
    sys.exit(1 if failures or not count else 0)


main()

"""What the tests of the program share: running it in a fresh folder, and counting as cmocka does.

Needs Python 3.8 and nothing else. Every run is searched for a sanitizer's report, and every failure must leave the folder as
it was: Case.run checks both, so no test can forget to.
"""
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

# Fonts of plots stay with fontconfig; a sanitizer that looks for leaks must know.
os.environ.setdefault("LSAN_OPTIONS", f"suppressions={ROOT}/tests/leaks.txt:print_suppressions=0")
EXAMPLE = os.path.join(ROOT, "examples", "jacksboro.tif")
SANITIZER = re.compile(r"AddressSanitizer|LeakSanitizer|runtime error:|ThreadSanitizer|MemorySanitizer")
TIMEOUT = 170
WRAPPER = []  # a program that runs the program, and its options


class Skip(Exception):
    """This test cannot be run here; says why."""


def shared(*parts):
    """A file of the data that is shared beside the sources; Skip where it is absent."""
    folder = os.environ.get("TALUS_SHARED") or os.path.join(
        os.environ.get("TALUS_SOURCE_ROOT") or ROOT, "..", "shared", "data")
    path = os.path.join(folder, *parts)
    if not os.path.exists(path):
        raise Skip(f"{parts[-1]} is not here")
    return path


def tool(name):
    path = shutil.which(name)
    if not path:
        raise Skip(f"{name} is not installed")
    return path


def snapshot(folder):
    """Every file below a folder and its content; hidden ones too."""
    found = {}
    for where, folders, files in os.walk(folder):
        for name in folders:
            found[os.path.relpath(os.path.join(where, name), folder)] = "folder"
        for name in files:
            path = os.path.join(where, name)
            found[os.path.relpath(path, folder)] = sha256(path)
    return found


def sha256(path):
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def expect(condition, text):
    if not condition:
        raise AssertionError(text)


class Result:
    def __init__(self, status, out, err, peak=0):
        self.status, self.out, self.err, self.peak = status, out, err, peak


class Case:
    """One test: a fresh folder, and the program run in it."""

    def __init__(self, program, folder):
        self.program, self.folder = program, folder

    def path(self, name):
        return os.path.join(self.folder, name)

    def start(self, *arguments, **options):
        options.setdefault("stdout", subprocess.PIPE)
        options.setdefault("stderr", subprocess.PIPE)
        options.setdefault("stdin", subprocess.DEVNULL)
        return subprocess.Popen([*WRAPPER, self.program, *map(str, arguments)], cwd=self.folder, **options)

    def run(self, *arguments, status=0, **options):
        """Runs the program and checks its exit status (None: any), that no sanitizer complains, and that a failure is told
        in lines that begin with "talus: " and leaves nothing behind."""
        before = snapshot(self.folder)
        process = self.start(*arguments, **options)
        try:
            out, err = process.communicate(timeout=TIMEOUT)
        finally:
            process.kill()
        result = Result(process.returncode, text(out), text(err))
        self.judge(result, arguments, status)
        if result.status != 0:
            expect(snapshot(self.folder) == before, f"{arguments}: a failed run changed the folder")
            if process.stderr:
                expect(result.err.startswith("talus"), f"{arguments}: failed without a word: {result.err!r}")
        return result

    def judge(self, result, arguments, status):
        expect(not SANITIZER.search(result.err), f"{arguments}: {result.err}")
        expect(result.status is not None and result.status >= 0, f"{arguments}: killed by signal {result.status}")
        if status is not None:
            expect(result.status == status, f"{arguments}: exit status {result.status}, not {status}: {result.err}")

    def peak_memory(self, *arguments):
        """Runs the program; its largest resident size in bytes. A process counts what the one that started it had in
        memory, so a small one does."""
        script = ("import resource, subprocess, sys; status = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL);"
                  "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss); sys.exit(status)")
        process = subprocess.run([sys.executable, "-I", "-S", "-c", script, self.program, *map(str, arguments)],
                                 cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, timeout=TIMEOUT)
        self.judge(Result(process.returncode, "", text(process.stderr)), arguments, 0)
        return int(process.stdout) * (1 if sys.platform == "darwin" else 1024)


def text(output):
    return output.decode("utf-8", "replace") if output else ""


def is_sanitized(program):
    """Whether the program was built with a sanitizer, whose own memory and speed are not the program's."""
    with open(program, "rb") as file:
        return b"__asan_init" in file.read()


def run_tests(program, tests):
    """Runs functions that take a Case, each in a folder of its own; prints cmocka's report; the exit status."""
    failed, skipped = [], []
    print(f"[==========] Running {len(tests)} test(s).", flush=True)
    for test in tests:
        name = getattr(test, "name", test.__name__)
        folder = tempfile.mkdtemp(prefix="talus-test-")
        os.chmod(folder, 0o755)
        print(f"[ RUN      ] {name}", flush=True)
        started = time.monotonic()
        try:
            test(Case(program, folder))
            print(f"[       OK ] {name} ({time.monotonic() - started:.1f} s)")
        except Skip as why:
            skipped.append(name)
            print(f"[  SKIPPED ] {name}: {why}")
        except Exception as error:  # any fault of one test fails that test only
            failed.append(name)
            print("".join(traceback.format_exception_only(type(error), error)), end="")
            if not isinstance(error, AssertionError) or not str(error):
                traceback.print_exc(file=sys.stdout)
            print(f"[  FAILED  ] {name}")
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    print(f"[==========] {len(tests)} test(s) run.")
    print(f"[  PASSED  ] {len(tests) - len(failed) - len(skipped)} test(s).")
    if skipped:
        print(f"[  SKIPPED ] {len(skipped)} test(s), listed below:")
        print("".join(f"[  SKIPPED ] {name}\n" for name in skipped), end="")
    if failed:
        print(f"[  FAILED  ] {len(failed)} test(s), listed below:")
        print("".join(f"[  FAILED  ] {name}\n" for name in failed), end="")
    sys.stdout.flush()
    return 1 if failed else 0


def default_signals():
    """For preexec_fn: a parent that ignores SIGINT must not pass that on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

"""The judges of tile pyramids: PROGRAM FOLDER. Kills a run at fifty moments, runs parts under GNU parallel, Open MPI and a
Slurm of its own, and compares what they leave byte for byte. A line a check; exit status 1 if one failed."""
import gzip
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time

PROGRAM, FOLDER = os.path.abspath(sys.argv[1]), os.path.abspath(sys.argv[2])
HERE = os.path.dirname(os.path.abspath(__file__))
EXAMPLES = os.path.join(HERE, "..", "..", "examples")
DEM = os.path.join(EXAMPLES, "jacksboro.tif")
WORDS = ["tiles", DEM, "-q", "-l", "11..15", "-e", "2"]  # several blocks, in some seconds
WORDS_3D = ["tiles", DEM, "-q", "-f", "3dtiles", "-x", "2", "-e", "2", "--layers", "colour"]
KILLS = 50
failed = []


def check(name, good, why=""):
    print(f"{'ok  ' if good else 'FAIL'} {name}{'' if good else ': ' + str(why)}", flush=True)
    if not good:
        failed.append(name)


def tree(folder):
    """One SHA-256 over the names and contents of all files."""
    digest = hashlib.sha256()
    for name in sorted(os.path.relpath(os.path.join(where, name), folder)
                       for where, _, names in os.walk(folder) for name in names):
        with open(os.path.join(folder, name), "rb") as file:
            digest.update(name.encode() + b"\0" + hashlib.sha256(file.read()).digest())
    return digest.hexdigest()


def files_are_whole(folder):
    """The name of a file that is not: every tile is one gzip stream with its own checksum, pieces are the program's."""
    for where, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(where, name)
            if name.endswith(".terrain"):
                try:
                    with gzip.open(path) as file:
                        file.read()
                except (OSError, EOFError) as error:
                    return f"{path}: {error}"
            if name.endswith(".glb"):
                with open(path, "rb") as file:
                    data = file.read()
                if int.from_bytes(data[8:12], "little") != len(data):
                    return f"{path}: {len(data)} bytes"
    return ""


def run(*words, **options):
    return subprocess.run([str(word) for word in words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                          check=False, **options)


def kills(whole, seconds, words, wanted):
    """Kills a run at a random moment, looks for torn files, and goes on; the next run ends it."""
    folder = os.path.join(FOLDER, "killed")
    dice = random.Random(8)
    torn, killed, different = "", 0, 0
    while killed < wanted:
        shutil.rmtree(folder, ignore_errors=True)
        for _ in range(5):  # now and then a run that goes on is killed too
            process = subprocess.Popen([PROGRAM, *words, "--resume", "-o", folder], stderr=subprocess.DEVNULL)
            time.sleep(dice.random() * seconds)
            process.send_signal(signal.SIGKILL)
            process.wait()
            killed += process.returncode == -signal.SIGKILL
            torn = torn or files_are_whole(folder)
        run(PROGRAM, *words, "--resume", "-o", folder)
        different += tree(folder) != whole
    check(f"{killed} kills leave no torn file", not torn, torn)
    check(f"after {killed} kills the tree is the same", not different, f"{different} trees differ")


def parts(name, whole, missing, make):
    """`make(folder, count)` runs all parts."""
    if missing:
        print(f"skip {name}: {missing} is not here", flush=True)
        return
    for count in (1, 2, 7):
        folder = os.path.join(FOLDER, f"{name}-{count}")
        done = make(folder, count)
        end = run(PROGRAM, *WORDS, "--finish", "-o", folder)
        good = done.returncode == 0 and end.returncode == 0 and tree(folder) == whole
        check(f"{name}, {count} parts", good, done.stdout + end.stdout)
        shutil.rmtree(folder, ignore_errors=True)


def by_parallel(folder, count):
    shards = [f"{k}/{count}" for k in range(count)]
    return run("parallel", "-j", 2, PROGRAM, *WORDS, "-t", 1, "-o", folder, "--shard", "{}", ":::", *shards)


def by_mpirun(folder, count):
    root = ["--allow-run-as-root"] if os.getuid() == 0 else []
    return run("mpirun", *root, "--oversubscribe", "-n", count, PROGRAM, *WORDS, "-t", 1, "-o", folder, "--shard", "auto")


class Slurm:
    """A cluster of this machine alone: munge, a controller and a node, all with files of their own; root only."""
    def __init__(self):
        self.folder = os.path.join(FOLDER, "slurm")
        self.processes = []
        for name in ("state", "spool", "munge"):
            os.makedirs(os.path.join(self.folder, name), exist_ok=True)
        os.chmod(FOLDER, 0o755)
        self.begin_munge()
        self.configure()
        self.start("slurmctld", "-D", "-f", self.conf)
        self.start("slurmd", "-D", "-f", self.conf)

    def start(self, *words):
        log = open(os.path.join(self.folder, words[0] + ".log"), "w", encoding="utf-8")
        self.processes.append(subprocess.Popen(words, stdout=log, stderr=log, cwd=self.folder,
                                               env={**os.environ, "SLURM_CONF": getattr(self, "conf", "")}))

    def begin_munge(self):
        munge = os.path.join(self.folder, "munge")
        key = os.path.join(munge, "key")
        with open(key, "wb") as file:
            file.write(os.urandom(1024))
        os.chmod(key, 0o400)
        os.chmod(munge, 0o755)
        self.socket = os.path.join(munge, "socket")
        self.start("munged", "-F", "-f", "--socket", self.socket, "--key-file", key, "--pid-file", munge + "/pid",
                   "--log-file", munge + "/log", "--seed-file", munge + "/seed")

    def configure(self):
        self.conf = os.path.join(self.folder, "slurm.conf")
        node = run("slurmd", "-C").stdout.split("\n")[0].split()
        keep = " ".join(word for word in node if word.split("=")[0] in ("NodeName", "CPUs", "RealMemory"))
        name = node[0].split("=")[1]
        with open(self.conf, "w", encoding="utf-8") as file:
            file.write(f"""ClusterName=judge
SlurmctldHost={name}(127.0.0.1)
AuthType=auth/munge
AuthInfo=socket={self.socket}
CredType=cred/munge
SlurmUser=root
SlurmctldPort=36817
SlurmdPort=36818
StateSaveLocation={self.folder}/state
SlurmdSpoolDir={self.folder}/spool
SlurmctldPidFile={self.folder}/slurmctld.pid
SlurmdPidFile={self.folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
MpiDefault=none
ReturnToService=2
SchedulerParameters=batch_sched_delay=0,sched_interval=1
{keep} NodeAddr=127.0.0.1 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
""")

    def ready(self):
        for _ in range(40):
            if run("sinfo", "-h", "-o", "%t", env={**os.environ, "SLURM_CONF": self.conf}).stdout.strip() in ("idle", "mix"):
                return True
            time.sleep(0.5)
        return False

    def array(self, folder, count):
        """The script of examples/slurm, as its users submit it."""
        return run("sbatch", "--wait", f"--array=0-{count - 1}", "--cpus-per-task=1", "--mem=0", "-o", "/dev/null",
                   os.path.join(EXAMPLES, "slurm", "tiles.sbatch"), folder, *WORDS[1:],
                   env={**os.environ, "SLURM_CONF": self.conf, "TALUS": PROGRAM})

    def end(self):
        for process in reversed(self.processes):
            process.terminate()
        for process in self.processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()


def missing(*programs):
    return ", ".join(program for program in programs if not shutil.which(program))


def slurm(whole):
    lacks = missing("sbatch", "slurmctld", "slurmd", "munged") or ("" if os.getuid() == 0 else "the right to start it")
    if lacks:
        parts("slurm", whole, lacks, None)
        return
    cluster = Slurm()
    try:
        if cluster.ready():
            parts("slurm", whole, "", cluster.array)
        else:
            print(f"skip slurm: its node did not come up; see {cluster.folder}", flush=True)
    finally:
        cluster.end()


def main():
    started = time.monotonic()
    folder = os.path.join(FOLDER, "whole")
    made = run(PROGRAM, *WORDS, "-o", folder)
    seconds = time.monotonic() - started
    check("tiles of the example", made.returncode == 0, made.stdout)
    if failed:
        return
    whole = tree(folder)
    only = sys.argv[3:]
    if not only or "parallel" in only:
        parts("parallel", whole, missing("parallel"), by_parallel)
    if not only or "mpirun" in only:
        parts("mpirun", whole, missing("mpirun"), by_mpirun)
    if not only or "slurm" in only:
        slurm(whole)
    if not only or "kills" in only:
        kills(whole, 1.1 * seconds, WORDS, KILLS)
    if not only or "kills3d" in only:
        started = time.monotonic()
        made = run(PROGRAM, *WORDS_3D, "-o", folder + "3d")
        check("3D Tiles of the example", made.returncode == 0, made.stdout)
        kills(tree(folder + "3d"), 1.1 * (time.monotonic() - started), WORDS_3D, KILLS // 2)


main()
sys.exit(bool(failed))

"""Kills parts of a cluster at random moments and asks whether every row is there, once and right.

    python cluster.py [--kills 24] [--seed 0] [--program PATH --captures FOLDER] [--keep]

Two Ray nodes, two drivers on one output and a server of S3, all on the loopback of a network
namespace of their own (unshare). 20 captures, of which one is refused and one hangs. Workers, the
second node, drivers, programs and their keepers get SIGKILL. Without --program the fake program
works; with it the folders of photos in FOLDER are the captures.
"""

import argparse
import hashlib
import json
import os
import random
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import s3_server
from splatvk.batch._program import clear_scratch

HERE = Path(__file__).parent
S3_PORT, RAY_PORT = 5555, 6399
#: An upload to the loopback takes a second; leases end before the last look.
LEASE = 25.0
#: Files with the times of their run.
TIMED = ("log.jsonl", "scene/run.json", "scene/report.html")


def processes():
    """Parent and command line by number."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
            line = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except (OSError, IndexError):
            continue
        if state != "Z":
            found[int(folder.name)] = (parent, line)
    return found


def below(root, table):
    """Descendants of a process."""
    children = {}
    for pid, (parent, _) in table.items():
        children.setdefault(parent, []).append(pid)
    found, stack = [], [root]
    while stack:
        for child in children.get(stack.pop(), ()):
            found.append(child)
            stack.append(child)
    return found


def has_variable(pid, text):
    try:
        return text.encode() in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return False


def eventually(true, seconds, what):
    begin = time.monotonic()
    while not true():
        if time.monotonic() - begin > seconds:
            raise SystemExit(f"after {seconds} s not: {what}")
        time.sleep(0.05)
    return time.monotonic() - begin


class Node:
    """`ray start --block` and what it starts."""

    def __init__(self, base, head):
        where = ["--head", f"--port={RAY_PORT}", "--include-dashboard=false", f"--temp-dir={base}/ray"]
        arguments = where if head else [f"--address=127.0.0.1:{RAY_PORT}"]
        self.base, self.head = base, head
        self.command = [
            str(Path(sys.executable).with_name("ray")),
            "start",
            *arguments,
            "--block",
            "--num-cpus=2",
            "--node-ip-address=127.0.0.1",
            "--object-store-memory=80000000",
        ]
        self.start()

    def start(self):
        self.was_up = False
        with open(self.base / f"node-{'head' if self.head else 'joined'}.log", "ab") as log:
            self.process = subprocess.Popen(self.command, stdout=log, stderr=log, start_new_session=True)

    def members(self, text, table):
        return [p for p in below(self.process.pid, table) if text in table[p][1]]

    def up(self):
        up = bool(self.members("raylet_socket_name", processes()))
        self.was_up |= up
        return up

    def lost(self):
        """Whether it was up once, and is not; one that starts is neither."""
        return not self.up() and (self.was_up or self.process.poll() is not None)

    def stop(self):
        """Ends all of it, by number."""
        table = processes()
        for pid in [self.process.pid, *below(self.process.pid, table)]:
            kill(pid)
        self.process.wait()


class Driver:
    def __init__(self, name, base, arguments):
        self.name, self.base, self.arguments = name, base, arguments
        self.starts = 0
        self.start()

    def job(self):
        """Ray's number of the driver, which its workers and their programs have in their environment."""
        for line in self.log.read_text().splitlines():
            if line.startswith("{") and json.loads(line)["event"] == "cluster":
                return json.loads(line)["job"]
        return None

    def start(self):
        self.starts += 1
        self.log = self.base / f"driver-{self.name}-{self.starts}.log"
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "splatvk.batch", *self.arguments], stdout=log, stderr=log
            )


def kill(pid):
    try:
        os.kill(pid, signal.SIGKILL)
        return True
    except ProcessLookupError:
        return False


class Test:
    def __init__(self, options, base):
        self.options, self.base = options, base
        self.random = random.Random(options.seed)
        self.table = []
        self.kills = Counter()
        self.gone = {}

    def rows(self, fs):
        """20 captures, every second one on the object store; and the reference of each."""
        rows = []
        captures = sorted(Path(self.options.captures).iterdir()) if self.options.captures else []
        for number in range(20):
            name = f"capture-{number:02}"
            if captures:
                folder = captures[number % len(captures)]
            else:
                folder = self.base / "photos" / name
                folder.mkdir(parents=True)
                for photo in range(3):
                    (folder / f"{photo}.jpg").write_bytes(f"{name} {photo}".encode() * 1000)
            row = {
                "id": name,
                "input": str(folder),
                "options": self.row_options(number),
                "queries": [],
                "exports": ["glb"],
            }
            if number == 7:
                row["options"] = {"colour": 1}
            elif number == 13:
                row["options"] = self.hanging()
            elif number % 2:
                fs.put(str(folder) + "/", f"photos/{name}/{folder.name}/", recursive=True)
                row["input"] = f"s3://photos/{name}/{folder.name}"
            rows.append((row, folder))
        return rows

    def row_options(self, number):
        if self.options.captures:
            return {
                "preset": "draft",
                "deterministic": True,
                "max_size": 160,
                "iterations": 60,
                "seed": number,
            }
        return {"seconds": round(self.random.uniform(3, 7), 2)}

    def hanging(self):
        return (
            {**self.row_options(0), "iterations": 10_000_000}
            if self.options.captures
            else {"hang": 1, "child": 1}
        )

    def reference(self, row, folder):
        """Digests of what one machine makes of the row, by path."""
        out = self.base / "reference" / row["id"]
        out.parent.mkdir(exist_ok=True)
        local = {**row, "input": [str(folder)]}
        if not self.options.captures:
            local["options"] = {}
        done = subprocess.run(
            [self.options.program, "batch-row", "--out", str(out)],
            input=json.dumps(local),
            text=True,
            capture_output=True,
        )
        if done.returncode:
            raise SystemExit(f"reference of {row['id']}: {done.stderr}")
        files = {p.relative_to(out).as_posix(): p for p in out.rglob("*") if p.is_file()}
        bits = {name: hashlib.sha256(p.read_bytes()).hexdigest() for name, p in files.items()}
        return {name: digest for name, digest in bits.items() if name not in ("_SUCCESS.json", *TIMED)}

    def targets(self, nodes, drivers):
        """What can be killed now, by kind."""
        table = processes()
        keepers = [p for p, (_, line) in table.items() if "_keeper.py" in line]
        programs = [
            p for p, (parent, line) in table.items() if parent in keepers and "batch-row --out" in line
        ]
        # Most moments are those of the program; a worker also fetches, uploads and commits.
        busy = [p for n in nodes for p in n.members("ray::splatvk", table)] if programs else []
        raylets = [p for p in nodes[1].members("raylet_socket_name", table)] if busy else []
        running = [d.process.pid for d in drivers if d.process.poll() is None] if busy else []
        return {
            "worker": busy,
            "raylet": raylets,
            "driver": running,
            "program": programs,
            "keeper": keepers,
        }, set(programs)

    def kill_one(self, nodes, drivers):
        found, programs = self.targets(nodes, drivers)
        # Kinds take turns, so that each is met often.
        kinds = [kind for kind, pids in found.items() if pids]
        if not kinds or not found["worker"]:
            return
        kind = min(kinds, key=lambda k: (self.kills[k], self.random.random()))
        pid = self.random.choice(found[kind])
        table = processes()
        keepers = set(found["keeper"])
        # Programs that must end with it: those below a worker, or of a node's workers.
        doomed = {p for p in below(pid, table) if p in programs or p in keepers}
        for driver in drivers:
            if driver.process.pid == pid:
                doomed = {p for p in programs | keepers if has_variable(p, f"RAY_JOB_ID={driver.job()}")}
        if not kill(pid):
            return
        self.kills[kind] += 1
        begin = time.monotonic()
        alive = lambda: [p for p in doomed if p in processes()]  # noqa: E731
        eventually(lambda: not alive(), 180, f"programs of the killed {kind} {pid} end")
        took = time.monotonic() - begin
        self.gone[kind] = max(self.gone.get(kind, 0.0), took if doomed else 0.0)
        self.table.append((kind, len(doomed), took))
        print(
            f"  kill {sum(self.kills.values()):2}: {kind:8} {len(doomed)} below it, gone after {took:.2f} s",
            flush=True,
        )

    def revive(self, nodes, drivers):
        if nodes[1].lost():
            nodes[1].stop()
            nodes[1].start()
        for driver in drivers:
            code = driver.process.poll()
            if code not in (None, 0, 1):
                driver.start()

    def round(self, number, nodes, manifest, fs):
        """Two drivers on a fresh output, until both have ended by themselves."""
        out = f"s3://scenes/round-{number}"
        arguments = [
            str(manifest),
            "--out",
            out,
            "--address",
            f"127.0.0.1:{RAY_PORT}",
            "--cpus-per-row",
            "1",
            "--retries",
            "30",
            "--timeout",
            str(self.options.timeout),
            "--lease",
            str(LEASE),
            "--scratch",
            str(self.base / "scratch"),
            "--log",
            "json",
        ]
        drivers = [Driver(f"{name}-{number}", self.base, arguments) for name in "ab"]
        begin = time.monotonic()
        next_kill = begin + self.random.uniform(4, 10)
        while any(d.process.poll() not in (0, 1) for d in drivers):
            if time.monotonic() > next_kill and sum(self.kills.values()) < self.options.kills:
                self.kill_one(nodes, drivers)
                next_kill = time.monotonic() + self.random.uniform(0.3, 4)
            self.revive(nodes, drivers)
            time.sleep(0.2)
            if time.monotonic() - begin > self.options.limit:
                raise SystemExit("the drivers do not end")
        wall = time.monotonic() - begin
        eventually(lambda: not self.orphans(), 60, "no orphans")
        starts = sum(d.starts for d in drivers)
        print(f"round {number}: {wall:.0f} s, {starts} drivers", flush=True)
        left = self.attempts(out, fs)
        # Uploads of killed workers go once their lease and the time of grace are over.
        time.sleep(2 * LEASE + 1)
        last = Driver(f"last-{number}", self.base, arguments)
        last.process.wait()
        return out, left, last.process.returncode

    def orphans(self):
        """Keepers and programs of this test; other processes of the machine are none of it."""
        found = [p for p, (_, line) in processes().items() if "batch-row --" in line or "_keeper.py" in line]
        return [p for p in found if has_variable(p, f"FAKE_SPLATVK_STATE={self.base}")]

    def attempts(self, out, fs):
        """Folders that no `_SUCCESS.json` names."""
        extra = 0
        for folder in fs.ls(out):
            name = folder.rpartition("/")[2]
            if not name.startswith("capture-"):
                continue
            inside = [e.rpartition("/")[2] for e in fs.ls(folder)]
            named = json.loads(fs.cat(f"{folder}/_SUCCESS.json"))["at"] if "_SUCCESS.json" in inside else None
            extra += sum(e not in ("_SUCCESS.json", named) for e in inside)
        return extra

    def check(self, out, rows, references, fs):
        """Every row once and right, and nothing else."""
        wrong = []
        for row, _ in rows:
            name, folder = row["id"], f"{out}/{row['id']}"
            if name in ("capture-07", "capture-13"):
                record = json.loads(fs.cat(f"{out}/_failed/{name}.json"))
                kind = "refused" if name == "capture-07" else "timeout"
                if record["kind"] != kind or fs.exists(folder):
                    wrong.append(f"{name}: {record['kind']}, not {kind}")
                continue
            if fs.exists(f"{out}/_failed/{name}.json"):
                wrong.append(f"{name}: has a failure too")
            try:
                success = json.loads(fs.cat(f"{folder}/_SUCCESS.json"))
            except FileNotFoundError:
                wrong.append(f"{name}: is missing")
                continue
            top = fs._strip_protocol(f"{folder}/{success['at']}")
            made = {p.removeprefix(top + "/"): hashlib.sha256(fs.cat(p)).hexdigest() for p in fs.find(top)}
            made = {name: digest for name, digest in made.items() if name not in TIMED}
            if made != references[name]:
                different = sorted(
                    p for p in {*made, *references[name]} if made.get(p) != references[name].get(p)
                )
                wrong.append(f"{name}: other bits in {', '.join(different[:5])} of {len(made)} files")
        if self.attempts(out, fs):
            wrong.append(f"{self.attempts(out, fs)} leftover attempts")
        return wrong


def run(options, base):
    environment = s3_server.environment(S3_PORT)
    environment |= {
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(24),
        "RAY_USAGE_STATS_ENABLED": "0",
        # Ray gives its workers, and so their programs, niceness 15.
        "RAY_worker_niceness": "0",
        "SPLATVK_PROGRAM": options.program,
        "FAKE_SPLATVK_STATE": str(base),
    }
    os.environ.update(environment)
    subprocess.Popen([sys.executable, str(HERE / "s3_server.py"), str(S3_PORT)])
    nodes, test = [], Test(options, base)
    try:
        import s3fs

        fs = s3fs.S3FileSystem(use_listings_cache=False)
        eventually(lambda: reachable(fs), 60, "the server of S3 answers")
        fs.mkdir("photos"), fs.mkdir("scenes")
        rows = test.rows(fs)
        failing = ("capture-07", "capture-13")
        references = {
            row["id"]: test.reference(row, folder) for row, folder in rows if row["id"] not in failing
        }
        manifest = base / "manifest.jsonl"
        manifest.write_text("".join(json.dumps(row) + "\n" for row, _ in rows))
        nodes.append(Node(base, head=True))
        eventually(nodes[0].up, 120, "the first node is up")
        time.sleep(5)
        nodes.append(Node(base, head=False))
        eventually(nodes[1].up, 120, "the second node is up")
        wrong, number = [], 0
        while sum(test.kills.values()) < options.kills or not number:
            number += 1
            out, left, code = test.round(number, nodes, manifest, fs)
            found = test.check(out, rows, references, fs)
            print(
                f"round {number}: {left} abandoned attempts before the last driver (exit code {code}); "
                f"wrong: {found or 'nothing'}",
                flush=True,
            )
            wrong += found
        # The next row on the node deletes the files of a worker that was killed with its keeper.
        clear_scratch(base / "scratch")
        scratch = list((base / "scratch").iterdir())
        wrong += [f"scratch folder {p} is left" for p in scratch]
    finally:
        table = processes()
        for pid in below(os.getpid(), table):
            kill(pid)
    print("\n| killed | times | slowest end of what it ran, s |\n|---|---|---|")
    for kind, times in sorted(test.kills.items()):
        print(f"| {kind} | {times} | {test.gone.get(kind, 0.0):.2f} |")
    print(
        f"{sum(test.kills.values())} kills in {number} rounds of {len(rows)} rows; "
        f"wrong: {wrong or 'nothing'}"
    )
    return 1 if wrong else 0


def reachable(fs):
    try:
        fs.ls("")
        return True
    except Exception:
        return False


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--program", default=str(HERE / "fake_splatvk"))
    parser.add_argument("--captures")
    parser.add_argument("--timeout", type=float, default=25.0)
    parser.add_argument("--limit", type=float, default=900.0)
    parser.add_argument("--keep", action="store_true", help="keep the logs")
    options = parser.parse_args()
    if "SPLATVK_CLUSTER_TEST" not in os.environ:
        # Ray binds to every interface it finds, so it gets one.
        command = ["unshare", "--map-root-user", "--net", "sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
        if os.geteuid() == 0:
            command.remove("--map-root-user")
        os.environ["SPLATVK_CLUSTER_TEST"] = "1"
        os.execvp("unshare", [*command, sys.executable, *sys.argv])
    # Ray's sockets need a short path.
    base = Path(tempfile.mkdtemp(prefix="sc-", dir="/tmp"))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(130))
    try:
        code = run(options, base)
    finally:
        if options.keep:
            print(f"logs in {base}")
        else:
            shutil.rmtree(base, ignore_errors=True)
    sys.exit(code)


if __name__ == "__main__":
    main()

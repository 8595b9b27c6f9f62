#!/usr/bin/env python3
"""Runs the steps of deploy/Dockerfile in a bare Debian without Docker, and trains a scene with the result.

    sudo scripts/containers.py        needs root, debootstrap and a Debian mirror; 5 minutes

It makes a root with debootstrap, runs RUN, COPY, ENV and USER of the targets coordinator and worker-cpu in
copies of it, and starts their entry points as their users. A small job must then succeed. The binary is the
development build of this checkout, in place of the one that the stage `build` makes. It also runs the steps
of the target worker, and asks its `fathom doctor` for a sentence about the missing GPU.
"""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")).resolve()
PORT = 7468


def fail(text):
    sys.exit(f"containers: {text}")


def instructions(text):
    """(word, rest) of each instruction, lines joined and comments left out."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n", " ", "\n".join(lines))
    return [tuple(line.split(None, 1)) for line in joined.splitlines() if line.strip()]


class Image:
    """A root with the settings of its last stage."""

    def __init__(self, root, environment, user=None, entry=None):
        self.root, self.environment, self.user, self.entry = root, dict(environment), user, entry

    def command(self, *words, user=True):
        known = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/"}
        pairs = [f"{key}={value}" for key, value in {**known, **self.environment}.items()]
        as_user = [f"--userspec={self.user}"] if user and self.user else []
        return ["chroot", *as_user, str(self.root), "env", "-i", *pairs, *words]

    def copy(self, into):
        subprocess.run(["cp", "-a", str(self.root), str(into)], check=True)
        return Image(into, self.environment, self.user, self.entry)


def build(wanted, bare, work):
    """The image of a target, from the stages that lead to it."""
    stages, current = {}, None
    for word, rest in instructions((ROOT / "deploy/Dockerfile").read_text()):
        if word == "FROM":
            source, name = re.fullmatch(r"(\S+) AS (\S+)", rest).groups()
            current = name
            stages[name] = (source, [])
        else:
            stages[current][1].append((word, rest))
    chain, name = [], wanted
    while name in stages:
        chain.append(name)
        name = stages[name][0]
    if not name.startswith("debian:bookworm"):
        fail(f"{wanted} begins with {name}, and only Debian bookworm can be made here")
    image = Image(bare, {}).copy(work / wanted)
    for name in reversed(chain):
        for word, rest in stages[name][1]:
            run_step(image, word, rest)
    return image


def run_step(image, word, rest):
    if word == "RUN":
        subprocess.run(image.command("/bin/sh", "-c", rest), check=True, stdout=subprocess.DEVNULL)
    elif word == "COPY":
        words = rest.split()
        made = words[0] == "--from=build"
        *sources, into = words[1:] if made else words
        target = image.root / into.lstrip("/")
        (target if into.endswith("/") else target.parent).mkdir(parents=True, exist_ok=True)
        for source in sources:
            shutil.copy(TARGET / "debug/fathom" if made else ROOT / source, target)
    elif word == "ENV":
        image.environment.update(pair.split("=", 1) for pair in shlex.split(rest))
    elif word == "USER":
        image.user = rest
    elif word == "ENTRYPOINT":
        image.entry = json.loads(rest)
    elif word not in ("WORKDIR", "VOLUME", "EXPOSE", "STOPSIGNAL"):
        fail(f"deploy/Dockerfile has {word}, which this script does not know")


def bare_debian():
    """A root of Debian bookworm, made once."""
    bare = TARGET / "containers/bookworm"
    if not bare.exists():
        part = bare.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        part.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(["debootstrap", "--variant=minbase", "bookworm", str(part)], check=True, stdout=subprocess.DEVNULL)
        # The sources of this machine, which may be a mirror.
        for name in ("sources.list", "sources.list.d", "apt.conf.d"):
            source = Path("/etc/apt") / name
            if source.is_dir():
                shutil.copytree(source, part / "etc/apt" / name, dirs_exist_ok=True)
            elif source.exists():
                shutil.copy(source, part / "etc/apt" / name)
        shutil.copy("/etc/resolv.conf", part / "etc/resolv.conf")
        part.rename(bare)
    return bare


def fathom(*words):
    done = subprocess.run([TARGET / "debug/fathom", *words], capture_output=True, text=True)
    if done.returncode:
        fail(f"fathom {' '.join(map(str, words))}: {done.stderr.strip()}")
    return done.stdout.strip()


def main():
    if os.geteuid() != 0:
        fail("run it as root: it makes a root file system")
    if not shutil.which("debootstrap"):
        fail("debootstrap is missing; apt-get install debootstrap")
    if not (TARGET / "debug/fathom").exists():
        fail("build the program first: make build")
    work, running, mounted = Path(tempfile.mkdtemp(prefix="fathom-containers-")), [], []
    try:
        images = {name: build(name, bare_debian(), work) for name in ("coordinator", "worker", "worker-cpu")}
        doctor = subprocess.run(images["worker"].command("fathom", "doctor"), capture_output=True, text=True)
        print(f"worker: fathom doctor: {(doctor.stdout + doctor.stderr).strip().splitlines()[-1]}")

        coordinator, worker = images["coordinator"], images["worker-cpu"]
        coordinator.environment |= {"FATHOM_LISTEN": f"127.0.0.1:{PORT}"}
        worker.environment |= {"FATHOM_COORDINATOR": f"http://127.0.0.1:{PORT}", "FATHOM_EXIT_WHEN_IDLE": "20s"}
        for image in (coordinator, worker):
            # Of the machine it has /proc alone; debootstrap made the few devices of /dev.
            subprocess.run(["mount", "-t", "proc", "proc", str(image.root / "proc")], check=True)
            mounted.append(image.root / "proc")
            running.append(subprocess.Popen(image.command(*image.entry), stdout=subprocess.DEVNULL))
            time.sleep(2)
        fathom("synth", work / "scene", "--views", "24", "--size", "96x72")
        at = ("--coordinator", f"http://127.0.0.1:{PORT}")
        job = fathom("submit", work / "scene", *at, "--iterations", "100", "--max-gaussians", "2000")
        fathom("watch", job, *at)
        users = {Path(f"/proc/{process.pid}").stat().st_uid for process in running}
        if users != {10001}:
            fail(f"the services run as users {users}, not as 10001")
        running[0].send_signal(signal.SIGTERM)
        if code := running[1].wait(timeout=60):
            fail(f"the worker ended with {code}, not by itself")
        print(f"coordinator and worker-cpu: job {job} succeeded, both as user 10001")
    finally:
        for process in running:
            process.kill()
            process.wait()
        for path in mounted:
            subprocess.run(["umount", str(path)], check=True)
        shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    main()

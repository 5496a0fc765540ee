"""A SLURM of one node on this machine, for as long as a test: munge, controller and daemon in a folder."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "scontrol")
SACCT = """#!/bin/sh
# What accounting knows, without its database: submitit reads the states of its jobs by this command.
echo "JobID|State|NodeList"
exec squeue --noheader --me --states=all --format="%i|%T|%N"
"""
CONF = """
ClusterName=test
SlurmctldHost={host}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={place}/munge.socket
CredType=cred/munge
StateSaveLocation={place}/state
SlurmdSpoolDir={place}/spool
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd.pid
SlurmctldLogFile={place}/slurmctld.log
SlurmdLogFile={place}/slurmd.log
SlurmctldPort={port}
SlurmdPort={port2}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
SchedulerParameters=sched_interval=1
KillWait=5
MinJobAge=60
SlurmdTimeout=10
NodeName={host} CPUs={cpus} State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP OverTimeLimit=0
"""


def missing() -> str | None:
    """Why there can be no SLURM here, None: there can."""
    if os.geteuid() != 0:
        return "SLURM's daemons need root"
    path = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"])
    absent = [name for name in PROGRAMS if shutil.which(name, path=path) is None]
    return f"there is no {', '.join(absent)}: apt-get install slurm-wlm munge" if absent else None


class SlurmNode:
    """A context: leaving it ends the daemons. `environment` makes the commands find this SLURM.

    Args:
        place: an empty folder with a short name: sockets lie there.
    """

    def __init__(self, place: Path) -> None:
        self.place = place
        self._daemons: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def environment(self) -> dict[str, str]:
        path = os.pathsep.join([str(self.place), os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"])
        return {"SLURM_CONF": str(self.place / "slurm.conf"), "PATH": path}

    def __enter__(self) -> SlurmNode:
        self.place.chmod(0o755)
        for name in ("state", "spool"):
            (self.place / name).mkdir()
        host = socket.gethostname().partition(".")[0]
        ports = [_free_port(), _free_port()]
        about = {
            "host": host,
            "place": self.place,
            "port": ports[0],
            "port2": ports[1],
            "cpus": os.cpu_count(),
        }
        (self.place / "slurm.conf").write_text(CONF.format(**about))
        (self.place / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
        (self.place / "sacct").write_text(SACCT)
        (self.place / "sacct").chmod(0o755)
        (self.place / "munge.key").write_bytes(os.urandom(128))
        (self.place / "munge.key").chmod(0o400)
        files = {"key-file": "munge.key", "socket": "munge.socket", "pid-file": "munge.pid"}
        files |= {"log-file": "munge.log", "seed-file": "munge.seed"}
        options = [f"--{name}={self.place / file}" for name, file in files.items()]
        self.start("munged", "--foreground", "--force", *options)
        for _ in range(100):
            if (self.place / "munge.socket").exists():
                break
            time.sleep(0.1)
        self.start("slurmctld", "-D", "-i")
        self.start("slurmd", "-D", "-N", host)
        for _ in range(300):
            found = self.run("sinfo", "-h", "-o", "%T")
            if found.stdout.strip() == "idle":
                return self
            time.sleep(0.2)
        log = (self.place / "slurmd.log").read_text() if (self.place / "slurmd.log").exists() else ""
        log += (self.place / "slurmctld.log").read_text()
        self.__exit__()
        raise RuntimeError(f"SLURM does not start: {found.stdout} {found.stderr}\n{log[-3000:]}")

    def __exit__(self, *_: object) -> None:
        for name in reversed(list(self._daemons)):
            self.stop(name)

    def start(self, name: str, *arguments: str) -> None:
        """Start a daemon of that name."""
        line = [shutil.which(name, path=self.environment["PATH"]) or name, *arguments]
        with (self.place / f"{name}.out").open("ab") as out:
            self._daemons[name] = subprocess.Popen(
                line, env={**os.environ, **self.environment}, stdout=out, stderr=out, stdin=subprocess.DEVNULL
            )

    def stop(self, name: str) -> None:
        """End a daemon."""
        daemon = self._daemons.pop(name)
        daemon.terminate()
        try:
            daemon.wait(10)
        except subprocess.TimeoutExpired:
            daemon.kill()
            daemon.wait()

    def run(self, *line: str) -> subprocess.CompletedProcess[str]:
        """Run one of SLURM's commands."""
        env = {**os.environ, **self.environment}
        return subprocess.run(line, env=env, capture_output=True, text=True, check=False)


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])

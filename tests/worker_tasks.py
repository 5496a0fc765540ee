"""What workers of the tests do: importable, because a fresh process looks for it by name."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path


def work(what: str, note: str) -> bytes:
    """Note the process, then do as told."""
    Path(f"{note}.new").write_text(str(os.getpid()))
    os.replace(f"{note}.new", note)  # whoever sees it can read it
    if what == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "exit":
        sys.exit(3)
    if what == "raise":
        raise OSError("no more memory")
    if what == "sleep":
        time.sleep(600)
    return what.encode()


if __name__ == "__main__":  # a parent of two workers, which are at work when it says so
    from staf_torch.sweeps.workers import Worker

    for number in (signal.SIGHUP, signal.SIGTERM):  # which `nohup` lets a whole suite ignore
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # as a shell's `&` does
    workers = [Worker(work) for _ in range(2)]
    for number, worker in enumerate(workers):
        worker.begin("sleep", sys.argv[1] + str(number))
    while not all(os.path.exists(sys.argv[1] + str(n)) for n in range(2)):
        time.sleep(0.01)
    print("at work", flush=True)
    time.sleep(600)

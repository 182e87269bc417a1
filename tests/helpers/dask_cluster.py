"""A dask cluster on this machine, started by dask's own command line."""

import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path

import psutil

from tests.helpers import ROOT

DASK = Path(sys.executable).with_name("dask")
LOCALHOST_ARGUMENTS = ("--host", "127.0.0.1")


@contextlib.contextmanager
def cluster(folder, workers, import_path=ROOT):
    """(address, processes of the workers) of a scheduler and workers here, their files in ``folder``."""
    environment = os.environ | {"PYTHONPATH": str(import_path), "OMP_NUM_THREADS": "1"}
    where = ["--scheduler-file", str(folder / "scheduler.json")]
    started = []

    def start(*command):
        process = subprocess.Popen(
            [str(DASK), *command],
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        started.append(process)
        return process

    try:
        start(
            "scheduler",
            *LOCALHOST_ARGUMENTS,
            "--port",
            "0",
            "--no-dashboard",
            "--dashboard-address",
            "127.0.0.1:0",
            *where,
        )
        machines = [
            start(
                "worker",
                *LOCALHOST_ARGUMENTS,
                "--nthreads",
                "1",
                "--no-dashboard",
                "--local-directory",
                str(folder),
                *where,
            )
            for _ in range(workers)
        ]
        from distributed import Client

        deadline = time.monotonic() + 60
        while not (folder / "scheduler.json").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        with Client(scheduler_file=str(folder / "scheduler.json"), timeout=60) as client:
            client.wait_for_workers(workers, timeout=60)
            yield client.scheduler.address, machines
    finally:
        family = [
            c for p in started if p.poll() is None for c in psutil.Process(p.pid).children(recursive=True)
        ]
        for process in [*started, *family]:
            with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
                process.kill()
        for process in started:
            process.wait()

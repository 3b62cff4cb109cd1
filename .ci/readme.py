"""Runs every command of README.md, from top to bottom, as a reader would.

A fenced block marked `sh` is run by bash and must succeed. One marked `sh background` is started, must bring up a server
that is ready and serves lanes, and is stopped by Ctrl-C at the end, which must succeed as well. `tests/run` is left to
the caller, who has just run it. The Python that README.md shows must be that of clients/python.
"""
import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request

ROOT = pathlib.Path(__file__).resolve().parent.parent
SERVER = "http://127.0.0.1:8080"
READY_WITHIN_S = 180
BLOCK_WITHIN_S = 600
STOPPED_WITHIN_S = 30
SHOWN_PYTHON = ROOT / "clients/python/stream_drive.py"
BLOCK = re.compile(r"^```sh( background)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def shell(commands):
    return ["bash", "-euo", "pipefail", "-c", commands]


def get(path):
    """Body of an answer with status 200, else nothing: the server may not be up yet."""
    try:
        with urllib.request.urlopen(SERVER + path, timeout=5) as response:
            return response.read()
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return None


def start(commands):
    if get("/readyz") is not None:
        sys.exit(f"another server already answers at {SERVER}")
    process = subprocess.Popen(shell(commands), cwd=ROOT, stdin=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + READY_WITHIN_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            sys.exit(f"ended with status {process.returncode} before it was ready: {commands}")
        lanes = get("/collections/lanes/items") if get("/readyz") is not None else None
        if lanes and json.loads(lanes)["features"]:
            return process
        time.sleep(0.2)
    interrupt(process)
    sys.exit(f"no lanes at {SERVER} within {READY_WITHIN_S} s: {commands}")


def interrupt(process):
    """Ctrl-C to the whole group, as a terminal sends it; the status that follows."""
    os.killpg(process.pid, signal.SIGINT)
    try:
        return process.wait(STOPPED_WITHIN_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return f"none within {STOPPED_WITHIN_S} s"


def main():
    readme = (ROOT / "README.md").read_text()
    if f"```python\n{SHOWN_PYTHON.read_text()}```" not in readme:
        sys.exit(f"README.md does not show {SHOWN_PYTHON.relative_to(ROOT)} as it is")
    running = []
    try:
        for background, commands in BLOCK.findall(readme):
            if commands.strip() == "tests/run":
                continue
            print(f"$ {commands.strip()}", flush=True)
            if background:
                running.append((commands, start(commands)))
            else:
                subprocess.run(shell(commands), cwd=ROOT, stdin=subprocess.DEVNULL, check=True, timeout=BLOCK_WITHIN_S)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as failure:
        sys.exit(f"README.md: {failure}")
    finally:
        stopped = [(commands.strip(), interrupt(process)) for commands, process in running]
    for commands, status in stopped:
        if status != 0:
            sys.exit(f"status {status} after Ctrl-C: {commands}")
    if not stopped:
        sys.exit("README.md starts no server: is the mark of its block still `sh background`?")


if __name__ == "__main__":
    main()

"""The notebook of the Python client runs from top to bottom against a fleet that drives, and draws.

    python tests/python/notebook_test.py target/debug/lanemap [FOLDER FOR ITS PLOTS]
"""
import base64
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time

import lanemap
import nbformat
from nbclient import NotebookClient

ROOT = pathlib.Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "clients/python/examples/plot_map.ipynb"
BINARY = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "target/debug/lanemap").resolve()
PLOTS = pathlib.Path(sys.argv[2]) if len(sys.argv) > 2 else None
LEAST_KM = 2.0
WITHIN_S = 60
PLOTS_DRAWN = 3


def map_of_a_fleet(url):
    """Waits until the fleet has mapped some road."""
    until = time.monotonic() + WITHIN_S
    with lanemap.Map(url) as map:
        for _ in map.watch(since=0):
            if sum(cell.line_km for cell in map.cells()) >= LEAST_KM:
                return
            assert time.monotonic() < until, "the fleet maps no road"


def run_notebook(url):
    os.environ["LANEMAP_URL"] = url
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "the notebook is kept without what it printed"
    NotebookClient(notebook, timeout=WITHIN_S, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    plots = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert len(plots) == PLOTS_DRAWN, f"{len(plots)} plots"
    printed = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert "Change(revision=" in printed and "next time: map.watch(since='" in printed, printed
    return [base64.b64decode(plot) for plot in plots]


def main():
    with tempfile.TemporaryDirectory() as folder:
        command = [BINARY, "demo", "--listen", "127.0.0.1:0", "--data-dir", folder, "--vehicles", "8", "--drive-km", "1"]
        server = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
        try:
            url = re.search(r"http://\S+?:\d+", server.stdout.readline()).group()
            map_of_a_fleet(url)
            plots = run_notebook(url)
        finally:
            server.send_signal(signal.SIGTERM)
            server.stdout.close()
            server.wait(WITHIN_S)
    for number, plot in enumerate(plots):
        if PLOTS is not None:
            PLOTS.mkdir(parents=True, exist_ok=True)
            (PLOTS / f"notebook-{number}.png").write_bytes(plot)
    print(f"the notebook runs and draws {len(plots)} plots")


if __name__ == "__main__":
    main()

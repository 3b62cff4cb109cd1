"""Makes the message types from ../../proto while the package is built: none are committed, none can be out of date."""

import pathlib
from importlib.resources import files

from setuptools import setup
from setuptools.command.build_py import build_py

HERE = pathlib.Path(__file__).resolve().parent
# The protocol of the repository, or its copy in a source distribution.
PROTO = next((folder for folder in (HERE.parents[1] / "proto", HERE / "proto") if (folder / "lanemap/v1").is_dir()), None)


class BuildMessages(build_py):
    """Builds the package, and the modules of `lanemap.v1` beside it."""

    def run(self) -> None:
        super().run()
        self.make_messages(HERE / "src" if self.editable_mode else pathlib.Path(self.build_lib))

    def make_messages(self, folder: pathlib.Path) -> None:
        from grpc_tools import protoc

        if PROTO is None:
            raise SystemExit("lanemap: the protocol (proto/lanemap/v1) is not beside this package")
        protos = sorted(str(path.relative_to(PROTO)) for path in PROTO.glob("lanemap/v1/*.proto"))
        well_known = str(files("grpc_tools") / "_proto")
        outputs = [f"--python_out={folder}", f"--pyi_out={folder}"]
        if protoc.main(["protoc", f"-I{PROTO}", f"-I{well_known}", *outputs, *protos]) != 0:
            raise SystemExit("lanemap: the protocol does not compile")
        (folder / "lanemap/v1/__init__.py").write_text('"""Messages of the protocol, made from proto/lanemap/v1."""\n')


setup(cmdclass={"build_py": BuildMessages})

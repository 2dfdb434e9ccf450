"""A fake program, photos, and places for results."""

import os
import signal
from pathlib import Path

import pytest
import s3_server

FAKE = Path(__file__).with_name("fake_splatvk")


@pytest.fixture(autouse=True)
def fake(tmp_path_factory, monkeypatch):
    """The fake program; its counters are in the folder."""
    state = tmp_path_factory.mktemp("state")
    monkeypatch.setenv("SPLATVK_PROGRAM", str(FAKE))
    monkeypatch.setenv("FAKE_SPLATVK_STATE", str(state))
    return state


@pytest.fixture
def scratch(tmp_path):
    return tmp_path / "scratch"


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "captures" / "shop"
    folder.mkdir(parents=True)
    for number in range(3):
        (folder / f"{number}.jpg").write_bytes(f"photo {number}".encode())
    return folder


@pytest.fixture(scope="session")
def s3():
    """A server of S3 on loopback, with the bucket `scenes`."""
    pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    with s3_server.served() as values, pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            patch.setenv(name, value)
        s3fs.S3FileSystem().mkdir("scenes")
        yield "s3://scenes"


@pytest.fixture(params=["folder", "s3", "memory"])
def place(request, tmp_path):
    """An address for results in each kind of store."""
    if request.param == "folder":
        return str(tmp_path / "out")
    if request.param == "s3":
        return f"{request.getfixturevalue('s3')}/{tmp_path.name}"
    pytest.importorskip("fsspec")
    return f"memory://{tmp_path.name}"


def running(text):
    """Processes whose command line or environment has a text."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if text in (folder / "cmdline").read_text() + (folder / "environ").read_text(errors="replace"):
                found.append(int(folder.name))
        except OSError:
            pass
    return [pid for pid in found if pid != os.getpid()]


@pytest.fixture
def processes(fake):
    """Processes that this test started, by its counters' folder in their environment."""
    yield lambda: running(str(fake))
    for pid in running(str(fake)):
        os.kill(pid, signal.SIGKILL)

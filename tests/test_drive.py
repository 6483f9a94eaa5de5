"""Driving by hand, as far as it needs no browser: who can reach the page, sliders to policy, how it ends. Each viewer runs in
a process of its own: a second one in one process hangs inside mujoco 4.0.0. In a real browser: tests/drive_browser.js."""
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import common
import pytest
import torch
from conftest import ROOT, load_policy
from test_maze import make_policy


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    make_policy(folder, "ant_semi")
    return folder


def run(folder, *flags, before=""):
    """Stage 4 in a process of its own; before: Python that runs first."""
    argv = ["04_mpc_maze.py", "--experiment", "drive", "--out", str(folder), "--pool", "64", *flags]
    code = f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{before}\nimport runpy\nsys.argv = {argv!r}\n"
    code += f"runpy.run_path({str(ROOT / '04_mpc_maze.py')!r}, run_name='__main__')"
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def port_of(process):
    """The port, once the page is there."""
    for line in process.stdout:
        if found := re.search(r"http://127\.0\.0\.1:(\d+)/", line):
            return int(found[1])
    raise AssertionError(process.stderr.read())


def opened(port):
    """The page; on a busy machine its address is printed a moment before the server listens."""
    for _ in range(50):
        try:
            return urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20)
        except urllib.error.URLError:
            time.sleep(0.1)
    raise AssertionError("nothing listens")


def listening(pid):
    """Local addresses, as the kernel writes them, of all sockets on which a process listens."""
    inodes = {os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()}
    rows = [row.split() for table in ("tcp", "tcp6")
            for row in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]]
    return [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in inodes]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_page_is_for_this_machine_alone_and_ctrl_c_ends_it(folder):
    process = run(folder, "--port", "0")
    try:
        port = port_of(process)
        page = opened(port)
        assert page.status == 200 and b"<html" in page.read().lower()
        sockets = listening(process.pid)
        assert any(int(local.split(":")[1], 16) == port for local in sockets)
        assert all(local.startswith("0100007F:") for local in sockets), sockets  # 127.0.0.1
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
        assert process.returncode == 0 and not err and len(out.splitlines()) == 1
    finally:
        process.kill()


def test_seconds_end_it(folder):
    out, err = run(folder, "--port", "0", "--seconds", "1").communicate(timeout=60)
    assert not err and re.search(r"\n[1-9]\d* steps, [\d.]+ a second\n$", out)


def test_a_method_without_axes_is_one_line(folder):
    make_policy(folder, "ant_dads", decoder=common.Decoder(2, 2, 8), method="dads", names=[], relation={})
    process = run(folder, "--method", "dads", "--modes", "printed", "--policy_seeds", "0")
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and len(err.splitlines()) == 1 and "driving needs WEDIS" in err, err


def test_a_port_in_use_is_one_line(folder):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        process = run(folder, "--port", str(other.getsockname()[1]))
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and len(err.splitlines()) == 1 and "--port" in err


def answer(port, *lines, body=b""):
    """The status line of what the server answers to a raw request, or "" if it hangs up."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode() + body)
        try:
            return client.recv(4096).decode(errors="replace").split("\r\n")[0]
        except ConnectionError:
            return ""


def test_a_foreign_page_gets_nothing_and_the_own_one_goes_on(folder):
    """Any page that the user's browser has open may send requests to this machine."""
    process = run(folder, "--port", "0", "--seconds", "40")
    upgrade = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
               "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]
    try:
        port = port_of(process)
        opened(port)
        own, get, page = f"Host: 127.0.0.1:{port}", "GET / HTTP/1.1", "GET /ui HTTP/1.1"
        for name in ("127.0.0.1", "localhost"):
            assert "101" in answer(port, page, f"Host: {name}:{port}", f"Origin: http://{name}:{port}", *upgrade)
            assert "200" in answer(port, get, f"Host: {name}:{port}")
        for origin in ("http://evil.example", f"http://127.0.0.1:{port + 1}", f"https://127.0.0.1:{port}", "null"):
            assert "403" in answer(port, page, own, f"Origin: {origin}", *upgrade), origin
        assert "403" in answer(port, page, own, *upgrade)  # no browser leaves Origin out here
        for host in ("evil.example", f"evil.example:{port}", f"127.0.0.1:{port + 1}", "127.0.0.1"):
            assert "403" in answer(port, get, f"Host: {host}"), host
            assert "403" in answer(port, page, f"Host: {host}", f"Origin: http://{host}", *upgrade), host
        assert "200" not in answer(port, get)
        for method in ("POST", "PUT"):
            refused = answer(port, f"{method} /drop HTTP/1.1", own, "Content-Length: 100000", body=b"x" * 100_000)
            assert "200" not in refused and "101" not in refused
        assert "403" in answer(port, "GET /drop/mine.xml HTTP/1.1", own)
        with socket.create_connection(("127.0.0.1", port), timeout=20) as client:  # garbage after a valid handshake
            client.sendall("\r\n".join([page, own, f"Origin: http://127.0.0.1:{port}", *upgrade, "", ""]).encode())
            assert b"101" in client.recv(4096)
            client.sendall(b"\xff\x00garbage" * 1000)
        time.sleep(1)
        assert process.poll() is None and opened(port).status == 200  # the simulation goes on
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
        assert process.returncode == 0 and re.search(r"[1-9]\d* steps", out) and "Traceback" not in err, err
    finally:
        process.kill()


OTHER_MUJOCO = {
    "no web viewer": "import mujoco.studio\nsys.modules['mujoco.studio.web_viewer'] = None",
    "no slider": "from mujoco.studio.dear_imgui import dear_imgui as gui\ndel gui.SliderFloat",
    "listens elsewhere": "from mujoco.studio import web_viewer\n"  # it no longer binds by the function that is replaced
                         "class Same:\n"
                         "    def __getattr__(self, name, m=web_viewer.web_server): return getattr(m, name)\n"
                         "    def __setattr__(self, name, value): pass\n"
                         "web_viewer.web_server = Same()",
}


@pytest.mark.parametrize("what", OTHER_MUJOCO)
def test_another_mujoco_is_one_line(folder, what):
    process = run(folder, "--port", "0", "--seconds", "20", before="import common\n" + OTHER_MUJOCO[what])
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and len(err.splitlines()) == 1 and "mujoco" in err, err


SLIDERS = """
import common, torch
from mujoco.studio.dear_imgui import dear_imgui as gui
values, commands = dict(z_speed=1.0, z_direction=-0.5, z_curvature=0.5), []
gui.SliderFloat = lambda name, value, *rest: (True, values.get(name, 0.0) if len(commands) > 10 else 0.0)
gui.Checkbox = lambda name, value: (False, False)
act = common.Actor.act
def kept(self, s, c, deterministic=False):
    commands.append(c[0].tolist())
    print("command", *c[0].tolist(), flush=True)
    return act(self, s, c, deterministic)
common.Actor.act = kept
"""


def test_sliders_reach_the_policy_through_the_viewer(folder):
    out, err = run(folder, "--port", "0", "--seconds", "3", before=SLIDERS).communicate(timeout=60)
    assert not err
    commands = torch.tensor([[float(v) for v in line.split()[1:]] for line in out.splitlines() if line.startswith("command")])
    assert commands[:10].norm(dim=1).max() <= common.CORRECTION + 1e-6  # it stands still: no more than the correction
    policy = load_policy(folder, "ant_semi", 0)
    expected = common.commands_of(policy, torch.tensor([[1.0, -0.5, 0.5]]), 1)[0, 0]
    assert (commands - expected).abs().amax(1).min() < 1e-4

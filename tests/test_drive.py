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
from contextlib import suppress
from pathlib import Path

import common
import numpy as np
import pytest
import torch
from conftest import ROOT, load_policy, script
from test_maze import make_policy
from websockets.exceptions import ConnectionClosed, ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    make_policy(folder, "ant_semi")
    return folder


def run(folder, *flags, before=""):
    """The page in a process of its own; before: Python that runs first."""
    argv = ["drive.py", "--out", str(folder), "--pool", "64", *flags]
    code = f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{before}\nimport runpy\nsys.argv = {argv!r}\n"
    code += f"runpy.run_path({str(ROOT / 'extras' / 'drive.py')!r}, run_name='__main__')"
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


@pytest.mark.parametrize("flags, line", [
    ("--mazes maze1,maze2", "unknown 'maze1,maze2' in --mazes"), ("--policy_seeds 0,0", "http"), ("--port x", "--port is 'x'"),
    ("--samples 1,2", "drive with one value of each"), ("--seconds -1", "--seconds is '-1'")])
def test_what_makes_no_sense_is_one_line(folder, flags, line):
    flags = flags.split()
    if line == "http":  # the same policy twice is one
        flags += ["--seconds", "1", "--port", "0"]
    out, err = run(folder, *flags).communicate(timeout=60)
    assert line in (out if line == "http" else err) and len(err.splitlines()) == (line != "http"), err


def test_the_planner_plans_with_commands_from_where_the_robot_is(s4, folder, monkeypatch):
    got = []
    drive = script("extras/drive")
    monkeypatch.setattr(drive, "drive", lambda *given: got.append(given))
    monkeypatch.setattr(sys, "argv", ["drive.py", "--out", str(folder), "--mazes", "maze1", "--seconds", "3", "--port", "1",
                                      "--samples", "50", "--pool", "64"])
    before = {name: value for name, value in vars(drive.importlib.import_module("04_mpc_maze")).items() if name.isupper()}
    try:
        drive.main()
    finally:
        vars(sys.modules["04_mpc_maze"]).update(before)
    (config, policy, spec, plan_to_goal, seconds, port), = got
    assert (config.mode, config.reward, config.maze, policy.method, seconds, port) == ("commands", "dense", "maze1", "wedis", 3.0, 1)
    assert len(spec.compile().geom_pos) > len(config.walls)
    place = torch.tensor([1.0, 2.0])
    z, path = plan_to_goal(place)
    assert z.shape == (3,) and path.shape == (16, 2) and torch.equal(path[0], place)
    step = config.hold * policy.scale * common.commands_of(policy, z[None], 5)[0]
    torch.testing.assert_close(path[:6].diff(dim=0), step, atol=1e-5, rtol=1e-4)


def test_a_port_in_use_is_one_line(folder):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        process = run(folder, "--port", str(other.getsockname()[1]))
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and len(err.splitlines()) == 1 and "--port" in err


UPGRADE = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]


def answer(port, *lines, body=b""):
    """The status that the server answers to a raw request, or "" if it hangs up."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode() + body)
        try:
            return client.recv(4096).decode(errors="replace")[9:12]
        except ConnectionError:
            return ""


def page_of(port, path, name="127.0.0.1"):
    """A WebSocket as the page opens it. The page's two sockets have the same sid."""
    return connect(f"ws://{name}:{port}{path}", origin=f"http://{name}:{port}", proxy=None, open_timeout=20, close_timeout=2)


def moves_on(page):
    """Whether a page that watches /state is sent two different states: the simulation runs."""
    states = set()
    for _ in range(400):
        message = page.recv(timeout=20)
        if isinstance(message, bytes):
            states.add(message)
            page.send("state_ack")
        if len(states) == 2:
            return True
    return False


def own_page_works(port):
    """The own page is there, and a new visitor drives the Ant: so nobody else does."""
    assert opened(port).status == 200
    with page_of(port, "/state?sid=own") as state, page_of(port, "/ui?sid=own"):
        for _ in range(400):
            message = state.recv(timeout=20)
            if isinstance(message, str) and "role=controller" in message:
                break
        else:
            raise AssertionError("somebody else drives")
        assert moves_on(state)


@pytest.fixture
def port(folder):
    """The port of a page that must live through the test, say nothing of errors and end by Ctrl-C."""
    process = run(folder, "--port", "0")
    try:
        port = port_of(process)
        own_page_works(port)
        yield port
        own_page_works(port)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
        assert process.returncode == 0 and not err and re.search(r"^[1-9]\d* steps, ", out, re.M)
    finally:
        process.kill()


def test_both_names_of_this_machine_are_its_own(port):
    for name in ("127.0.0.1", "localhost"):
        with page_of(port, "/state?sid=one", name) as state:
            assert moves_on(state)
        assert answer(port, "GET / HTTP/1.1", f"Host: {name}:{port}") == "200"


def test_a_foreign_page_drives_nothing(port):
    """Any page that the user's browser has open may send requests to this machine, with its own Origin."""
    host, own = f"Host: 127.0.0.1:{port}", f"Origin: http://127.0.0.1:{port}"
    for origin in ("http://evil.example", f"http://evil.example:{port}", f"http://127.0.0.1:{port + 1}", "http://127.0.0.1",
                   f"https://127.0.0.1:{port}", f"http://localhost:{port}", f"http://127.0.0.1:{port}.evil.example", "null", ""):
        for path in ("/ui?sid=evil", "/state?sid=evil", "/drop?sid=evil"):
            assert answer(port, f"GET {path} HTTP/1.1", host, f"Origin: {origin}", *UPGRADE) == "403", (origin, path)
        assert answer(port, "GET /model HTTP/1.1", host, f"Origin: {origin}") == "403", origin
        own_page_works(port)
    assert answer(port, "GET /ui HTTP/1.1", host, *UPGRADE) == "403"  # a browser never leaves it out here
    assert answer(port, "GET /ui HTTP/1.1", host, own, "Origin: http://evil.example", *UPGRADE) == "403"


def test_a_foreign_host_gets_nothing(port):
    """A foreign name may be made to lead to this machine (DNS rebinding): its page has the right Origin for its Host."""
    for host in ("evil.example", f"evil.example:{port}", f"127.0.0.1:{port + 1}", "127.0.0.1", "localhost", f"127.0.0.2:{port}",
                 f"[::1]:{port}", f"127.0.0.1:{port}.evil.example", f"evil@127.0.0.1:{port}", ""):
        assert answer(port, "GET / HTTP/1.1", f"Host: {host}") == "403", host
        assert answer(port, "GET /ui HTTP/1.1", f"Host: {host}", f"Origin: http://{host}", *UPGRADE) == "403", host
        own_page_works(port)
    assert answer(port, "GET / HTTP/1.1") == "403"
    assert answer(port, "GET / HTTP/1.0") == "403"
    assert answer(port, "GET /ui HTTP/1.1", f"Origin: http://127.0.0.1:{port}", *UPGRADE) == "403"
    assert answer(port, "GET / HTTP/1.1", f"Host: 127.0.0.1:{port}", "Host: evil.example") == "403"


def test_no_upload_is_kept(port):
    """mujoco keeps what the page that drives sends to /drop, as large as 64 MB each; here not even that page may."""
    host, own = f"Host: 127.0.0.1:{port}", f"Origin: http://127.0.0.1:{port}"
    with page_of(port, "/ui?sid=driver"), pytest.raises(InvalidStatus, match="403"):
        page_of(port, "/drop?sid=driver")
    own_page_works(port)
    for method in ("POST", "PUT"):
        for path in ("/drop", "/"):
            for length in ("Content-Length: 100000", "Transfer-Encoding: chunked"):
                refused = answer(port, f"{method} {path} HTTP/1.1", host, own, length, body=b"x" * 100_000)
                assert refused not in ("200", "101", "426"), (method, path, length)
            foreign = answer(port, f"{method} {path} HTTP/1.1", host, "Origin: http://evil.example")
            assert foreign == "403", (method, path)
        own_page_works(port)
    for path in ("/ui?sid=large", "/state?sid=large"):
        with page_of(port, path) as page:
            page.send(bytes(2 ** 21))
            with pytest.raises(ConnectionClosedError, match="1009"):  # too big
                for _ in range(400):
                    page.recv(timeout=20)
        own_page_works(port)


def test_garbage_drops_its_sender_alone(port):
    rng, own = np.random.default_rng(0), [f"Host: 127.0.0.1:{port}", f"Origin: http://127.0.0.1:{port}"]
    with page_of(port, "/state?sid=watches") as other:
        for path in ("/ui?sid=bad", "/state?sid=bad"):  # no frame of a WebSocket
            with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
                client.sendall("\r\n".join([f"GET {path} HTTP/1.1", *own, *UPGRADE, "", ""]).encode())
                assert b" 101 " in client.recv(4096)
                client.sendall(b"\xff\x00garbage" * 1000)
            assert moves_on(other)
        # Frames of which the viewer's own protocol understands nothing. It hangs up while they are written: SIGPIPE.
        for first in (bytes(120), rng.bytes(120), rng.bytes(5000), b"", "text") * 2:
            with page_of(port, "/ui?sid=bad") as page, suppress(ConnectionClosed):
                page.send(first)
                time.sleep(0.2)
                page.send(rng.bytes(100_000))
                page.send(rng.bytes(100_000))
            assert moves_on(other)
            own_page_works(port)
        with page_of(port, "/ui?sid=bad"), page_of(port, "/state?sid=bad") as page:  # it drives: a camera, a theme ..
            for message in (b"", rng.bytes(88), rng.bytes(5000), b"\xff" * 88, "theme=\u2603", "max_spectators=x", "\u2603"):
                page.send(message)
            assert moves_on(page)
        assert moves_on(other)


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
    sys.stdout.write("\\ncommand " + " ".join(map(str, c[0].tolist())) + "\\n")  # whole: the viewer's thread prints too
    sys.stdout.flush()
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

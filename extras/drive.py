"""Drive the Ant by hand, in a web page with a slider for each axis of z. Not in the paper.

python extras/drive.py [--mazes maze1] [--port 8080] [--seconds 30] [any flag of 04_mpc_maze.py]
--port 0: the first free one; --seconds: until the page ends by itself, 0: when it is closed.
"""
import importlib
import logging
import signal
import sys
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import common
import mujoco
import numpy as np
import torch


def dot(place, *colour):
    """A ball on the floor at place (2,), metres, for MuJoCo's viewer."""
    geom = mujoco.MjvGeom()
    mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.1), np.array([*place, 0.1]),
                        np.eye(3).ravel(), np.float32(colour))
    return geom


def for_this_page_alone(web_server):
    """Change mujoco's server before it starts: it listens on this machine only, and answers its own page
    only. Any page that a browser has open could else drive the Ant. Returns an event: the server listens."""
    bind, serve, listens = web_server.bind_public_socket, web_server.serve, threading.Event()
    web_server.bind_public_socket = lambda host, port: bind("127.0.0.1", port)  # else on every interface

    async def serve_own_page(handler, **options):
        port, answer = options["sock"].getsockname()[1], options["process_request"]
        own = [f"{name}:{port}".removesuffix(":80") for name in ("127.0.0.1", "localhost")]

        def check(connection, request):
            hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
            if not origins and "Upgrade" not in request.headers:  # a browser fetches pages without Origin
                origins = [f"http://{host}" for host in hosts]
            allowed = [([host], [f"http://{host}"]) for host in own]
            if (hosts, origins) not in allowed or request.path.startswith("/drop"):  # /drop keeps uploads
                return connection.respond(403, "for its own page on this machine alone\n")
            return answer(connection, request)

        options |= dict(process_request=check, max_size=2 ** 20)  # bytes of a message; 64 MB with uploads
        server = await serve(handler, **options)
        listens.set()
        return server

    web_server.serve = serve_own_page
    return listens


def drive(config, policy, spec, plan_to_goal, seconds, port):
    """Sliders in a web page command the Ant in real time. mujoco serves the page, to this machine alone.
    config: of 04; spec: its maze; plan_to_goal: Algorithm 2, from a place (2,) to z (M,) and a path."""
    if not policy.names:
        common.stop("driving needs WEDIS, whose axes have names")
    robots, data = common.Robots(spec, 1), mujoco.MjData(spec.compile())
    hand = SimpleNamespace(mode="start again", closed=True, text="", geoms=[],  # set by the page's thread
                           z={"z_" + name: 0.0 for name in policy.names})
    asked, steps, start, pages = None, 0, time.monotonic(), []
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Ctrl-C ends it below
    if hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # a page that goes away must not end this process
    try:
        from mujoco.studio import launch_web, messages, plugin, viewer_protocol, web_viewer
        from mujoco.studio.dear_imgui import dear_imgui as gui

        class Panel(plugin.ViewerPlugin):  # the viewer's thread calls it, 60 times a second, page or no page
            @messages.handler
            def look(self, event: messages.PostModelEvent):
                host, port = self.viewer._http_sock.getsockname()[:2]
                if host != "127.0.0.1":
                    raise RuntimeError("it would listen beyond this machine")
                if not listens.wait(10):
                    raise RuntimeError("it would answer every page")
                camera, torso = self.viewer.camera, data.model.body("torso").id
                camera.type, camera.distance, camera.trackbodyid = 1, 12, torso  # 1: it follows the Ant
                print(f"drive the Ant at http://{host}:{port}/ (Ctrl-C ends it)", flush=True)

            @messages.handler
            def build(self, event: messages.BuildGuiEvent):
                gui.Begin("drive the Ant", True, int(gui.WindowFlags.AlwaysAutoResize))
                high = config.z_range
                z = {name: gui.SliderFloat(name, at, -high, high, "%.2f")[1] for name, at in hand.z.items()}
                if z != hand.z:
                    hand.z, hand.mode = z, "by hand"
                for mode in ("stand still", "start again", "plan to the goal"):
                    if gui.Button(mode):
                        hand.mode = mode
                hand.closed = gui.Checkbox("closed loop", hand.closed)[1]
                gui.TextUnformatted(hand.text)
                gui.End()
                self.viewer.extra_geoms[:] = hand.geoms

        listens = for_this_page_alone(web_viewer.web_server)
        web_viewer.print = web_viewer._print_url_banner = lambda *words, **options: None
        for name in ("", "websockets"):
            logging.getLogger(name).setLevel("CRITICAL")  # errors of the viewer are raised as well
        logging.getLogger("WebServer").addFilter(pages.append)  # who comes and goes; None hides the line
        with launch_web.launch(viewer_protocol.ViewerConfig(http_port=port), plugins=[Panel()]) as handle:
            handle.set_model(data.model, data=data)
            while handle.is_running() and not 0 < seconds <= time.monotonic() - start:
                if pages and "(0 total)" in pages[-1].getMessage() and time.time() > pages[-1].created + 10:
                    break  # the last page is closed; one that reloads is back sooner
                mode, z, closed = hand.mode, hand.z, hand.closed
                if asked != (mode, z, closed):
                    asked, commands, t = (mode, z, closed), [], 0
                    skills = config.episode // (config.hold * config.length)  # left for the plan
                if t == len(commands):  # a skill begins
                    if mode == "start again":
                        robots.reset([0])
                        trail = []
                    place, skill = robots.place(), torch.tensor([list(z.values())])
                    if mode == "plan to the goal" and skills:
                        skill, skills = plan_to_goal(place[0])[0][None], skills - 1
                    elif mode != "by hand":
                        mode = hand.mode = "stand still"
                    c = common.commands_of(policy, skill, config.length) * (mode != "stand still")
                    commands, t = c[0].repeat_interleave(config.hold, 0), 0  # one for each environment step
                    path = torch.cat([place, place + policy.scale * commands.cumsum(0)])  # where they lead
                command = commands[t:t + 1]
                if closed:
                    command = common.closed_loop(command, path[t:t + 1], robots, policy.scale)
                action = policy.actor.act(robots.observe(), command, deterministic=True)
                _, unstable = robots.step(action.numpy())
                if unstable.any():
                    hand.mode = "start again"
                t += 1
                trail.append(robots.place()[0])
                speed, error = commands.norm(dim=1).mean(), (path[t] - trail[-1]).norm()
                hand.text = f"mean command {speed:.2f}, tracking error {error:.2f} m"
                hand.geoms = ([dot(p, 0.8, 0.4, 0, 1) for p in trail[::10][-200:]]  # orange
                              + [dot(p, 0, 0.4, 0.7, 1) for p in path[t + 1::10]])  # blue
                data.qpos[:] = robots.qpos[0]
                handle.sync()
                steps += 1
                time.sleep(max(0, start + 0.05 * steps - time.monotonic()))
    except KeyboardInterrupt:
        pass
    except (ImportError, AttributeError, TypeError, KeyError, RuntimeError, OverflowError) as error:
        common.stop(f"cannot drive in a browser with mujoco {mujoco.__version__} at --port {port}: {error}")
    print(f"{steps} steps, {steps / (time.monotonic() - start):.2f} a second")


def main():
    stage = importlib.import_module("04_mpc_maze")
    # parse_flags finds constants, their types and the help in a module: add to those of 04
    vars(stage).update(MAZES="open", REWARDS="dense", MODES="commands", TRIALS=1, SECONDS=0.0, PORT=8080)
    stage.__annotations__ |= dict(SECONDS=float, PORT=int)
    stage.__doc__ = __doc__
    runs = stage.check(*common.parse_flags(vars(stage)))
    if len(runs) > 1:
        common.stop("drive with one value of each: --method, --mazes, --modes, --rewards, --policy_seeds, "
                    "--samples")
    torch.set_num_threads(1)
    case, policy, _ = runs[0]
    planner = partial(stage.plan, case, policy, stage.skill_pool(case, policy), case.planned)
    drive(case, policy, stage.maze_spec(case), planner, stage.SECONDS, stage.PORT)


if __name__ == "__main__":
    main()

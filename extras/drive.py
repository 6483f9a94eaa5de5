"""Drive the Ant by hand, in a web page with a slider for each axis of z. Not in the paper.

Started by: python 04_mpc_maze.py --experiment drive [--mazes maze1] [--seconds 30] [--port 8080]
"""
import logging
import signal
import time
from types import SimpleNamespace

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


def drive(u, spec, pool, plan, seconds, port):
    """Sliders in a web page command the Ant in real time. mujoco serves the page, to this machine alone.
    u, spec, pool: the unit, the maze and the skills of 04; plan: Algorithm 2, for the button."""
    if not u.policy.names:
        common.stop("driving needs WEDIS, whose axes have names")
    robots, data = common.Robots(spec, 1), mujoco.MjData(spec.compile())
    hand = SimpleNamespace(mode="start again", closed=True, text="", geoms=[],  # set by the page's thread
                           z={"z_" + name: 0.0 for name in u.policy.names})
    asked, steps, start, pages = None, 0, time.monotonic(), []
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Ctrl-C ends it below
    try:
        from mujoco.studio import launch_web, messages, plugin, viewer_protocol, web_viewer
        from mujoco.studio.dear_imgui import dear_imgui as gui

        class Panel(plugin.ViewerPlugin):  # the viewer's thread calls it, 60 times a second, page or no page
            @messages.handler
            def look(self, event: messages.PostModelEvent):
                host, port = self.viewer._http_sock.getsockname()[:2]
                if host != "127.0.0.1":
                    raise RuntimeError("it would listen beyond this machine")
                camera, torso = self.viewer.camera, data.model.body("torso").id
                camera.type, camera.distance, camera.trackbodyid = 1, 12, torso  # 1: it follows the Ant
                print(f"drive the Ant at http://{host}:{port}/ (Ctrl-C ends it)", flush=True)

            @messages.handler
            def build(self, event: messages.BuildGuiEvent):
                gui.Begin("drive the Ant", True, int(gui.WindowFlags.AlwaysAutoResize))
                z = {name: gui.SliderFloat(name, at, -1.5, 1.5, "%.2f")[1] for name, at in hand.z.items()}
                if z != hand.z:
                    hand.z, hand.mode = z, "by hand"
                for mode in ("stand still", "start again", "plan to the goal"):
                    if gui.Button(mode):
                        hand.mode = mode
                hand.closed = gui.Checkbox("closed loop", hand.closed)[1]
                gui.TextUnformatted(hand.text)
                gui.End()
                self.viewer.extra_geoms[:] = hand.geoms

        bind = web_viewer.web_server.bind_public_socket  # would listen on every interface
        web_viewer.web_server.bind_public_socket = lambda host, port: bind("127.0.0.1", port)
        web_viewer.print = web_viewer._print_url_banner = lambda *words, **options: None
        logging.getLogger().setLevel("CRITICAL")  # errors of the viewer are raised as well
        logging.getLogger("WebServer").addFilter(pages.append)  # who comes and goes; None hides the line
        with launch_web.launch(viewer_protocol.ViewerConfig(http_port=port), plugins=[Panel()]) as handle:
            handle.set_model(data.model, data=data)
            while handle.is_running() and not 0 < seconds <= time.monotonic() - start:
                if pages and "(0 total)" in pages[-1].getMessage() and time.time() > pages[-1].created + 10:
                    break  # the last page is closed; one that reloads is back sooner
                mode, z, closed = hand.mode, hand.z, hand.closed
                if asked != (mode, z, closed):
                    asked, left, ahead = (mode, z, closed), u.planned, []
                if not ahead:  # a skill begins
                    if mode == "start again":
                        robots.reset([0])
                        trail = []
                    place, skill = robots.place()[0], torch.tensor([list(z.values())])
                    if mode == "plan to the goal" and left:
                        skill, left = plan(u, "dense", u.samples[0], left, pool, place)[0][None], left - 1
                    elif mode != "by hand":
                        mode = hand.mode = "stand still"
                    c = common.commands_of(u.policy, skill, u.length) * (mode != "stand still")
                    skill_steps = common.execute(u.policy, robots, c, u.hold, closed, deterministic=True)
                    ahead = list(place + u.policy.scale * c[0].repeat_interleave(u.hold, 0).cumsum(0))
                next(skill_steps)
                trail.append(robots.place()[0])
                error = (ahead.pop(0) - trail[-1]).norm()
                hand.text = f"mean command {c.norm(dim=2).mean():.2f}, tracking error {error:.2f} m"
                hand.geoms = ([dot(p, 0.8, 0.4, 0, 1) for p in trail[::10][-200:]]  # orange
                              + [dot(p, 0, 0.4, 0.7, 1) for p in ahead[::10]])  # blue
                data.qpos[:] = robots.qpos[0]
                handle.sync()
                steps += 1
                time.sleep(max(0, start + 0.05 * steps - time.monotonic()))
    except KeyboardInterrupt:
        pass
    except (ImportError, AttributeError, TypeError, RuntimeError, OverflowError) as error:
        common.stop(f"cannot drive in a browser with mujoco {mujoco.__version__} at --port {port}: {error}")
    print(f"{steps} steps, {steps / (time.monotonic() - start):.2f} a second")

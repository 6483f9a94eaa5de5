"""Pictures of MuJoCo's renderer for 04_mpc_maze.py: Fig 14, and the GIFs (not in the paper)."""
import io
from functools import cache
from pathlib import Path

import common  # before mujoco: it chooses how mujoco renders
from common import plt
import mujoco
from PIL import Image, ImageDraw  # comes with matplotlib


@cache  # or a second try, after one that failed, would end the process
def can_render():
    """Whether MuJoCo can draw off-screen. If not, says so once."""
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception:  # its kind differs by platform
        print("no Fig 14, no GIF: MuJoCo's renderer finds no GL library (on Linux: install EGL, libegl1)")
        return False
    return True


def render(model, poses, height, width):
    """Pictures (height, width, 3) of a model in poses (n, nq)."""
    renderer, data, pictures = mujoco.Renderer(model, height, width), mujoco.MjData(model), []
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        renderer.update_scene(data)
        pictures.append(renderer.render())
    renderer.close()
    return pictures


def fig14(out):
    """Fig 14: both robots."""
    if not can_render():
        return
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2))
    for ax, name in zip(axes, ("ant", "half_cheetah")):
        model = common.robot_spec(name).compile()
        model.stat.extent = 2.2  # metres, what the default camera shows
        model.vis.map.shadowclip = 2  # or the floor is speckled
        ax.imshow(*render(model, model.key_qpos[:1], 400, 500))
        ax.set(title=name, xticks=[], yticks=[])
        ax.grid(False)
    common.save_figure(figure, out, "fig14_robots")


def gif(maze_spec, examples, out):
    """A GIF per maze: the last example with the first reward, so in the last mode. maze_spec(configuration):
    the model; examples: those of 04."""
    if not can_render():
        return
    first = next(iter(examples))[3]
    last = {c.maze: (c, poses) for c, poses, _ in examples.values() if c.reward == first}
    for maze, (c, poses) in last.items():
        spec = maze_spec(c)
        for x, y in poses[::10, :2]:
            spec.worldbody.add_site(pos=[x, y, 0], size=[0.15, 0.15, 0.15], rgba=[0, 0.45, 0.7, 1])
        model = spec.compile()
        model.vis.global_.azimuth, model.vis.global_.elevation = 90, -65
        model.stat.extent *= 0.37  # the walls fill the picture
        pictures = [Image.fromarray(picture) for picture in render(model, poses[::8], 320, 480)]
        for picture in pictures:
            ImageDraw.Draw(picture).text((10, 6), f"{c.method}, {c.mode}", "black", font_size=18)
        palette = pictures[0].quantize(48, Image.Quantize.MAXCOVERAGE)  # one for all, or colours flicker
        frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
        buffer = io.BytesIO()
        frames[0].save(buffer, "GIF", save_all=True, append_images=frames[1:], duration=80, loop=0)
        print(f"wrote {common.write_whole(Path(out) / 'figures' / f'{maze}.gif', buffer.getvalue())}")

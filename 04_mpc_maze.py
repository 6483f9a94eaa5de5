"""Stage 4: decoder + policy -> mazes solved zero-shot, by MPC with trajectory scaling (Sec. 5, Algorithm 2, Table 2).

Reads runs/policy_*.pt (or the one in pretrained/). Plans with random shooting over skills, executes on the MuJoCo Ant between
walls of real geoms, prints one table and writes results/mazes.csv, Fig 6 (mazes), Fig 8 (examples) and a GIF per maze.
Takes 2.5 minutes on two cores (AMD EPYC 7003).
"""
import time
from pathlib import Path

import common  # before mujoco: it chooses how mujoco renders
from common import (STEP_SCALE, Robots, ant_spec, bootstrap_interval, execute, load, load_actor, load_decoder, parse_flags, plt,
                    predict, save_figure, stop, update_csv, write_whole)
import mujoco
import numpy as np
import torch
from PIL import Image  # comes with matplotlib

EXPERIMENT = "main"        # row of EXPERIMENTS below
SEED = 0                   # random seed of the trials
OUT = "."                  # folder for runs/, figures/ and results/
THREADS = 2                # CPU threads
POLICY = "ant_semi"        # experiment of 03
POLICY_SEED = 0            # and its seed
METHOD = "wedis"           # named in results/
MAZES = "maze1 maze2"      # rows of the table MAZE below
REWARDS = "dense sparse"   # Sec. 6.2
PREDICTIONS = "relation decoder"  # what the planner believes: the relation function's path, or the decoder's T free steps (the paper)
OBJECTIVES = "final"       # reward of the last planned state, or "sum" over all of them (the paper does not say)
TRIALS = 50                # per configuration; all step together
ANIMATE = True             # false: no GIFs

EPISODE = 600              # H_E, environment steps (Table 2)
HOLD = 40                  # H_z, steps for which z_single is held
LENGTH = 5                 # T, transitions per skill
PLANNED_DENSE = 3          # H_P, skills planned ahead, dense reward
PLANNED_SPARSE = 3         # H_P, sparse reward
SAMPLES = 1000             # N, skill sequences per plan
Z_RANGE = 1.5              # skills ~ U(-Z_RANGE, Z_RANGE); speed ~ U(0, Z_RANGE): slower is useless here (App. A.1.4)
PENALTY = 100.0            # w_p, for each colliding transition of a plan
REWARD = 5.0               # w_r, sparse
EPSILON = 5.0              # metres, acceptable error: sparse reward and success
RADIUS = 1.0               # metres the planner grows walls by: the Ant's reach

EXPERIMENTS = {  # a row names the constants in which an experiment differs from the ones above
    "main": {},
}

START, GOAL = (0.0, 0.0), (24.0, 12.0)  # metres; 26.8 apart, 36 along the axes
HULL = [(-7, -6, -7, 19), (31, 32, -7, 19), (-7, 32, -7, -6), (-7, 32, 18, 19)]  # x0, x1, y0, y1
MAZE = {
    "maze1": HULL + [(17, 18, 5, 18), (5, 18, 5, 6)],   # L; the chamber at the top left is the trap
    "maze2": HULL + [(7, 8, 4, 18), (16, 17, -6, 8)],   # Z; the chamber at the bottom right is the trap
}


# ---------------------------------------------------------------- the maze

def maze_spec(walls):
    """The Ant between real walls 1 m high, a sensor that says whether they touch, and the goal as a picture."""
    spec = ant_spec()
    maze = spec.worldbody.add_body(name="maze")
    for x0, x1, y0, y1 in walls:
        maze.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=[(x0 + x1) / 2, (y0 + y1) / 2, 0.5], conaffinity=1,
                      size=[(x1 - x0) / 2, (y1 - y0) / 2, 0.5], rgba=[0.45, 0.5, 0.6, 1])
    spec.worldbody.add_site(pos=[*GOAL, 0.1], type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.8, 0.1, 0], rgba=[0.85, 0.2, 0.1, 1])
    spec.add_sensor(name="touch", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_BODY, objname="maze",
                    reftype=mujoco.mjtObj.mjOBJ_XBODY, refname="torso", intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1])
    return spec


def collides(path, walls):
    """Which transitions of the paths (N, K + 1, 2) cross a wall grown by RADIUS: (N, K) bool. Exact for segments and
    rectangles: along a segment, the times inside the x-slab and inside the y-slab must overlap within [0, 1]."""
    start, step = path[:, :-1, None], path[:, 1:, None] - path[:, :-1, None]  # (N, K, 1, 2) against rectangles (R, 2)
    box = torch.tensor(walls, dtype=path.dtype)
    step = torch.where(step.abs() < 1e-9, 1e-9, step)
    a = (box[:, 0::2] - RADIUS - start) / step
    b = (box[:, 1::2] + RADIUS - start) / step
    enter, leave = torch.minimum(a, b).amax(3), torch.maximum(a, b).amin(3)
    return ((enter <= leave) & (leave >= 0) & (enter <= 1)).any(2)


# ---------------------------------------------------------------- Algorithm 2

def scaled_path(decoder, weight, start, z):
    """Alg. 2, lines 5-8, with its slips mended: the path of skills z (N, H_P, 3) from start (2,) goes on from the last planned
    state, and each transition is STEP_SCALE H_z delta. Returns (N, H_P T + 1, 2) in metres."""
    delta = predict(decoder, z.flatten(0, 1), LENGTH, weight).view(len(z), -1, 2)
    return start + STEP_SCALE * HOLD * torch.nn.functional.pad(delta.cumsum(1), (0, 0, 1, 0))


def plan(decoder, weight, start, horizon, walls, sparse, objective, generator):
    """Random shooting: the best of SAMPLES skill sequences. Returns its first skill (3,) and whole path (H_P T + 1, 2)."""
    z = Z_RANGE * (2 * torch.rand(SAMPLES, horizon, 3, generator=generator) - 1)
    z[..., 0] = z[..., 0].abs()
    path = scaled_path(decoder, weight, start, z)
    r = -(path[:, 1:] - torch.tensor(GOAL)).norm(dim=2)
    if sparse:
        r = REWARD * (r.abs() < EPSILON).float()
    score = (r[:, -1] if objective == "final" else r.sum(1)) - PENALTY * collides(path, walls).sum(1)
    best = score.argmax()
    return z[best, 0], path[best]


def run(actor, decoder, weight, maze, reward, prediction, objective):
    """TRIALS episodes of MPC at once. Returns rows for the CSV and, per trial, the positions (steps + 1, 2), the poses
    (steps + 1, 15) and the path predicted at each decision (T + 1, 2)."""
    torch.manual_seed(SEED)
    walls, robots = MAZE[maze], Robots(maze_spec(MAZE[maze]), TRIALS, THREADS)
    robots.reset(np.arange(TRIALS), np.random.default_rng(SEED))
    touch = robots.batch.bind("sensordata")
    generators = [torch.Generator().manual_seed(1000 * SEED + trial) for trial in range(TRIALS)]
    decisions = EPISODE // (HOLD * LENGTH)
    ahead = min(decisions, PLANNED_SPARSE if reward == "sparse" else PLANNED_DENSE)
    contacts, poses, plans, planning = np.zeros(TRIALS, int), [robots.qpos.copy()], [], 0.0
    for i in range(decisions):
        clock = time.perf_counter()
        position = torch.from_numpy(robots.qpos[:, :2].astype(np.float32))
        best = [plan(decoder, weight if prediction == "relation" else None, position[n], min(ahead, decisions - i), walls,
                     reward == "sparse", objective, generators[n]) for n in range(TRIALS)]  # never past the episode's end
        planning += (time.perf_counter() - clock) / TRIALS / decisions
        plans.append(torch.stack([path[:LENGTH + 1] for _, path in best]).numpy())
        for _, unstable in execute(actor, robots, torch.stack([z for z, _ in best]), LENGTH, HOLD, weight, deterministic=False):
            if unstable.any():
                stop(f"MuJoCo found trial {unstable.argmax()} of {maze} unstable; choose another --seed or train the policy longer", code=1)
            contacts += touch[:, 0] > 0
            poses.append(robots.qpos.copy())
    poses = np.stack(poses, 1)
    distance = np.linalg.norm(poses[..., :2] - GOAL, axis=2)
    length = np.linalg.norm(np.diff(poses[..., :2], axis=1), axis=2).sum(1)
    rows = [dict(maze=maze, reward=reward, method=METHOD, prediction=prediction, objective=objective, look_ahead=ahead * HOLD * LENGTH,
                 samples=SAMPLES, trial=n, seed=SEED, final_distance=distance[n, -1], min_distance=distance[n].min(),
                 success=int(distance[n, -1] < EPSILON), contacts=contacts[n], path_length=length[n], planning_ms=1e3 * planning)
            for n in range(TRIALS)]
    return rows, poses, np.stack(plans, 1)


def summary(rows):
    """One line of the table, from CSV rows of one configuration: mean final distance with its 95 % bootstrap interval."""
    d = np.array([float(row["final_distance"]) for row in rows])
    low, high = bootstrap_interval(d)
    success = 100 * np.mean([int(row["success"]) for row in rows])
    contacts = np.mean([int(row["contacts"]) for row in rows])
    first = rows[0]
    return (f"| {first['maze']} | {first['reward']} | {first['prediction']} | {first['objective']} | {d.mean():.2f} | {low:.2f} .. {high:.2f} "
            f"| {np.median(d):.2f} | {success:.0f} % | {contacts:.0f} | {len(d)} |")


HEADER = ("| maze | reward | prediction | objective | mean final distance (m) | 95 % interval | median | success (< 5 m) | wall steps | trials |\n"
          "|---|---|---|---|---|---|---|---|---|---|")


# ---------------------------------------------------------------- pictures

def draw_maze(axes, maze):
    for x0, x1, y0, y1 in MAZE[maze]:
        axes.add_patch(plt.Rectangle((x0, y0), x1 - x0, y1 - y0, color="#7a869a", lw=0))
    axes.plot(*START, "o", ms=5, color="black")
    axes.set(xlim=(-7, 32), ylim=(-7, 19), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.grid(False)


def draw_fig06():
    """Fig 6: the two navigation tasks, goals as red circles."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
    for ax, maze in zip(axes, ("maze1", "maze2")):
        draw_maze(ax, maze)
        ax.add_patch(plt.Circle(GOAL, 1.0, color=common.RED))
        ax.annotate("start", START, (1, -2.5))
        ax.set_title(f"Maze {maze[-1]}")
    save_figure(figure, OUT, "fig06_mazes")


def draw_fig08(runs):
    """Fig 8: the first three trials of each maze. Blue: predicted at each decision, red: executed, cross: goal, dashed grey:
    the error between the last positions of the two at each planning step."""
    figure, axes = plt.subplots(len(runs), 3, figsize=(11, 2.7 * len(runs)), squeeze=False)
    for row, (maze, reward, (rows, poses, plans)) in zip(axes, runs):
        for n, ax in enumerate(row[:len(rows)]):
            draw_maze(ax, maze)
            for i, path in enumerate(plans[n]):
                end = poses[n, (i + 1) * HOLD * LENGTH, :2]
                ax.plot(*path.T, ".-", color=common.BLUE, ms=4, lw=1.4, label="predicted" if i == 0 else None)
                ax.plot(*np.stack([path[-1], end]).T, "--", color=common.GREY, lw=1.2, label="error of the end" if i == 0 else None)
            ax.plot(*poses[n, :, :2].T, color=common.RED, lw=1.2, label="executed")
            ax.plot(*GOAL, "x", color="black", ms=8, mew=2, label="goal")
            ax.set_title(f"{maze}, {reward}, trial {n}: ends {float(rows[n]['final_distance']):.1f} m away")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    save_figure(figure, OUT, "fig08_mpc_examples")


def animate(maze, poses, every=6):
    """GIF of one run from its poses (steps + 1, 15): rendered by mujoco (left the maze, right the Ant), or where there is no GL
    library a top view with the Ant's legs by matplotlib. Says which."""
    model = maze_spec(MAZE[maze]).compile()
    data, frames = mujoco.MjData(model), []
    try:
        renderer, how = mujoco.Renderer(model, 240, 360), "rendered by mujoco"
    except Exception:  # no GL library, no display, no device: the kinds differ by platform
        renderer, how = None, "drawn by matplotlib (for MuJoCo's renderer install an EGL or OSMesa library)"
    for i in range(0, len(poses), every):
        data.qpos[:] = poses[i]
        mujoco.mj_forward(model, data)
        if renderer is None:
            frames.append(top_view(maze, model, data, poses[:i + 1]))
            continue
        views = []
        for lookat, distance, elevation in (((12.5, 5.5, 0), 35, -70), ((*poses[i, :2], 0.5), 5, -35)):
            camera = mujoco.MjvCamera()
            camera.lookat, camera.distance, camera.azimuth, camera.elevation = lookat, distance, 90, elevation
            renderer.update_scene(data, camera)
            for x, y in poses[:i + 1:10, :2]:  # the trail
                mujoco.mjv_initGeom(renderer.scene.geoms[renderer.scene.ngeom], mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.2),
                                    np.array([x, y, 0.15]), np.eye(3).ravel(), np.array([0.84, 0.37, 0, 1], np.float32))
                renderer.scene.ngeom += 1
            views.append(renderer.render().copy())
        frames.append(Image.fromarray(np.concatenate(views, 1)))
    path = Path(OUT) / "figures" / f"{maze}.gif"
    frames = [frame.quantize(64, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE) for frame in frames]
    write_whole(path, lambda file: frames[0].save(file, "GIF", save_all=True, append_images=frames[1:] + [frames[-1]] * 10,
                                                  duration=60, loop=0, optimize=True))
    print(f"wrote figures/{path.name}, {how}")


def top_view(maze, model, data, trail):
    figure, ax = plt.subplots(figsize=(6, 3.6), dpi=80)
    draw_maze(ax, maze)
    ax.plot(*trail[:, :2].T, color=common.RED, lw=1)
    ax.plot(*GOAL, "x", color="black", ms=8, mew=2)
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE):
        reach = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
        ax.plot(*np.stack([data.geom_xpos[geom] - reach, data.geom_xpos[geom] + reach])[:, :2].T, color="#6b4a2b", lw=2)
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
    plt.close(figure)
    return image


if __name__ == "__main__":
    config = parse_flags(globals())
    for what, given, allowed in (("maze", MAZES, MAZE), ("reward", REWARDS, ("dense", "sparse")),
                                 ("prediction", PREDICTIONS, ("relation", "decoder")), ("objective", OBJECTIVES, ("final", "sum"))):
        if not given or (wrong := set(given.split()) - set(allowed)):
            stop(f"unknown {what} {' '.join(sorted(wrong)) if given else ''!r}; allowed: {' '.join(allowed)}")
    if min(TRIALS, SAMPLES, HOLD, LENGTH) < 1 or EPISODE < HOLD * LENGTH:
        stop("--trials, --samples, --hold and --length must be at least 1, and --episode at least hold x length")
    torch.set_num_threads(THREADS)
    policy = load(OUT, "policy", POLICY, POLICY_SEED)
    actor, decoder, weight = load_actor(policy), load_decoder(policy), policy["relation_weight"]
    if len(actor.s_mean) != 27 or len(decoder.axes) != 3:
        stop(f"policy {POLICY} is not an Ant with speed, direction and curvature; choose --policy ant_semi")

    start, table, examples, films = time.time(), [], [], {}
    for maze in MAZES.split():
        for objective in OBJECTIVES.split():
            for reward in REWARDS.split():
                for prediction in PREDICTIONS.split():
                    rows, poses, plans = run(actor, decoder, weight, maze, reward, prediction, objective)
                    update_csv(Path(OUT) / "results" / "mazes.csv", rows,
                               ("maze", "reward", "method", "prediction", "objective", "look_ahead", "samples", "seed", "trial"))
                    table.append(summary(rows))
                    print(f"{time.time() - start:4.0f} s  {table[-1]}  {rows[0]['planning_ms']:.0f} ms a plan", flush=True)
                    if prediction == "relation" and objective == "final":
                        films.setdefault(maze, poses[0])
                        examples += [(maze, reward, (rows, poses, plans))] * (reward == "sparse")
    print(f"\n{HEADER}\n" + "\n".join(table))
    print(f"staying at the start scores {np.hypot(*np.subtract(GOAL, START)):.1f} m; seed {SEED}, {SAMPLES} samples, "
          f"policy {POLICY} seed {POLICY_SEED}")
    draw_fig06()
    if examples:
        draw_fig08(examples)
    for maze, poses in films.items():
        if ANIMATE:
            animate(maze, poses)

"""Stage 3: decoder -> skill policy pi(a | s, z_single), trained by SAC on single steps (Sec. 4.2, App. A.1.3).

Reads runs/wetvae_*.pt. The reward is the decoder's log-likelihood of the step just made (Eq. 6), computed when a batch is
sampled, so that any stored step can be relabelled with a fresh skill. Writes runs/policy_<experiment>_seed<seed>.pt,
Fig 5, the learning curve (figures/, results/) and a row of results/policies.csv.
Takes 56 minutes on two cores that do nothing else (63 updates/s; AMD EPYC 7003, no AVX-512). Expect, n = 1 (seed 0): tracking error 0.22 with
mean and 0.18 with sampled actions, direction error 3.8 degrees, middle and fast skills at 0.9 of their speed, slow ones at 0.3.
"""
import math
import time
from pathlib import Path

import numpy as np
import torch
from torch import nn

import common
from common import (FULL_RANGE, STEP_SCALE, Actor, Robots, ant_spec, artifact_name, check_same, cross_talk, execute, factors_of, load,
                    load_actor, load_decoder, parse_flags, plt, predict, resumable, save, save_figure, stop, update_csv)

EXPERIMENT = "ant_semi"  # row of EXPERIMENTS below
SEED = 0                 # random seed
OUT = "."                # folder for runs/, figures/ and results/
TRAIN = True             # false: only measure and draw what is already trained
RESUME = False           # true: continue from the last checkpoint
THREADS = 2              # CPU threads
UPDATES = 200_000        # SAC updates; the schedules below run over them (the paper: 1.92 million)
POLISH = 12_000          # further updates at TEMPERATURE_END
MINUTES = 0.0            # if not 0, the schedules run out with this clock instead, whatever UPDATES says
CHECKPOINT = 5.0         # minutes between checkpoints, which are made after a report
REPORTS = 40             # printed lines and points of the learning curve

DECODER = "main"         # experiment of 02 whose decoder is the reward
DECODER_SEED = 0         # and its seed
METHOD = "wedis"         # named in results/
ROBOT = "ant"            # named in results/

ROBOTS = 64              # environments that step together
EPISODE = 200            # steps until a robot starts anew; not terminal: the value beyond is bootstrapped
SKILL_STEPS = 100        # steps until a robot is given a new skill
WARM_UP = 10_000         # steps with random actions; their statistics normalise the state
REPLAY = 1_000_000       # steps kept
UPDATES_PER_STEP = 8     # updates after each step of all robots
BATCH = 256              # App. A.1.3
RELABELLED = 0.5         # share of a batch given a fresh skill from the prior (hindsight)

HIDDEN = 256             # width of the two hidden layers (the paper: 512)
LEARNING_RATE = 1e-3     # Adam, decays linearly to 0 over the second half (the paper: 3e-4, fixed)
DISCOUNT = 0.97          # gamma of Eq. 1 (the paper: 0.99)
SMOOTHING = 0.01         # of the target value network, App. A.1.3
REWARD_SCALE = 0.1       # the paper: 1
TEMPERATURE = 0.01       # alpha, weight of the entropy, App. A.1.3
TEMPERATURE_END = 0.001  # while polishing: the paper's 0.01 times REWARD_SCALE; the mean action nears what the policy does
VARIANCE_SCALE = 0.05    # decoder variance -> square metres, App. A.1.3: 1/20
FLOOR_START = 0.04       # metres, least standard deviation of the reward: a sharp one makes standing still a trap
FLOOR_END = 0.01         # shrinks to this between half and nine tenths of the updates: teaches the slow skills

COVERAGE = 200           # random skills whose visited cells of 1 m are counted at the end

EXPERIMENTS = {  # a row names the constants in which an experiment differs from the ones above
    "ant_semi": {},
}


# ---------------------------------------------------------------- SAC: twin critics, value network, fixed temperature

class Critics(nn.Module):
    """Q_1 and Q_2 as one stack of batched matrix products (one call instead of two). (B, n), (B, m) -> (2, B)."""

    def __init__(self, n_in):
        super().__init__()
        sizes = [n_in, HIDDEN, HIDDEN, 1]
        layers = [[nn.Linear(a, b) for a, b in zip(sizes, sizes[1:])] for _ in range(2)]  # torch's own initialisation
        self.weights = nn.ParameterList(torch.stack([one.weight.T, two.weight.T]).detach() for one, two in zip(*layers))
        self.biases = nn.ParameterList(torch.stack([one.bias, two.bias])[:, None].detach() for one, two in zip(*layers))

    def forward(self, x, a):
        h = torch.cat([x, a], 1).expand(2, -1, -1)
        h = torch.relu(torch.baddbmm(self.biases[0], h, self.weights[0]))
        h = torch.relu(torch.baddbmm(self.biases[1], h, self.weights[1]))
        return (h * self.weights[2].mT).sum(2) + self.biases[2].squeeze(2)  # a product with one column is faster as a sum


def value_network(n_in):
    return nn.Sequential(nn.Linear(n_in, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))


def reward(decoder, z, displacement, floor):
    """Eq. 6 for one step: log p(displacement | z_single, z_multi = 0) minus its value at the decoder's mean, (B,).

    z (B, 2), displacement (B, 2) in metres, floor in metres. The subtracted term depends on z only: same objective."""
    mean, log_var = decoder(nn.functional.pad(z, (0, len(decoder.axes) - z.shape[1])), 1)
    variance = (VARIANCE_SCALE * log_var[:, 0].exp()).clamp(min=floor ** 2)
    return REWARD_SCALE * -0.5 * ((displacement - STEP_SCALE * mean[:, 0]) ** 2 / variance).sum(1)


def sac_losses(actor, critics, value, target, x, a, x2, r, temperature):
    """Losses of the actor, the twin critics and the value network (Haarnoja et al. 2018). x, x2 (B, n): state and skill
    before and after the step; a (B, m); r (B,). Every step is followed by another: time limits are not terminal."""
    with torch.no_grad():
        q_target = r + DISCOUNT * target(x2).squeeze(1)
    q_loss = 0.5 * ((critics(x, a) - q_target) ** 2).mean(1).sum()
    a_new, log_prob = actor(x)
    a_leaf = a_new.detach().requires_grad_()
    q_new = critics(x, a_leaf).min(0).values
    # the trap: a plain backward through q_new would also train the critics to please the actor, and cost another pass
    slope, = torch.autograd.grad(q_new.sum(), a_leaf)
    actor_loss = (temperature * log_prob - (slope * a_new).sum(1)).mean()
    v_loss = 0.5 * ((value(x).squeeze(1) - (q_new - temperature * log_prob).detach()) ** 2).mean()
    return actor_loss, q_loss, v_loss


# ---------------------------------------------------------------- measuring

def grid_run(actor, decoder, deterministic=True):
    """DESIGN's tracking grid: 5 x 5 (speed, direction) in [-1.5, 1.5], 100 steps from rest at H_z = 100.
    Returns executed and predicted end points (25, 2) in metres and which robots were ever upside down (25,)."""
    g = torch.linspace(-1.5, 1.5, 5)
    z = nn.functional.pad(torch.cartesian_prod(g, g), (0, 1))
    robots, flipped = Robots(ant_spec(), 25, THREADS), np.zeros(25, bool)
    for _ in execute(actor, robots, z, 1, 100, 0.0, deterministic):
        x, y = robots.qpos[:, 4:6].T  # of the torso's quaternion; its up-vector has height 1 - 2 (x^2 + y^2)
        flipped |= 1 - 2 * (x ** 2 + y ** 2) < 0
    return robots.qpos[:, :2].copy(), (100 * STEP_SCALE * predict(decoder, z, 1)[:, 0]).double().numpy(), flipped


def tracking(executed, predicted):
    """Tracking error RMS(executed - predicted) / RMS(predicted); for the five speeds, mean |direction error| in degrees and
    mean achieved / commanded distance (along the commanded direction)."""
    error = np.sqrt(((executed - predicted) ** 2).sum(1).mean() / (predicted ** 2).sum(1).mean())
    turn = np.angle((executed[:, 0] + 1j * executed[:, 1]) / (predicted[:, 0] + 1j * predicted[:, 1]), deg=True)
    ratio = (executed * predicted).sum(1) / (predicted ** 2).sum(1)
    return error, abs(turn).reshape(5, 5).mean(1), ratio.reshape(5, 5).mean(1)


def paths(actor, z, steps, hold, weight):
    """Executed positions (n, steps * hold + 1, 2) in metres of skills z (n, 3) from rest, mean actions."""
    robots = Robots(ant_spec(), len(z), THREADS)
    track = [robots.qpos[:, :2].copy()]
    for _ in execute(actor, robots, z, steps, hold, weight, deterministic=True):
        track.append(robots.qpos[:, :2].copy())
    return np.stack(track, 1)


def traversal(axis, values):
    z = torch.zeros(len(values), 3)
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    return z


def calibrate_relation(decoder, steps=5):
    """The weight of f_dir(z_dir, z_cur) = z_dir + weight z_cur (Sec. 4.2.2) from the decoder alone: headings of single steps
    at z_dir + k weight z_cur against headings of step k of the decoder's free run, least squares over a grid of skills
    whose headings stay where a semicircle is trained (65 degrees). Returns the weight and a function weight -> RMS in degrees."""
    g = torch.linspace(-1.5, 1.5, 13)
    z = torch.cartesian_prod(torch.tensor([0.0, 0.75, 1.5]), g, g)
    free = torch.view_as_complex(predict(decoder, z, steps))
    inside = (free.angle().abs() < math.radians(65)).all(1)

    def mismatch(weight):
        relation = torch.view_as_complex(predict(decoder, z, steps, weight))
        return (relation / free).angle()[inside].rad2deg().square().mean().sqrt().item()

    low, high = -1.0, 1.0
    while high - low > 1e-4:  # the mismatch has one valley
        a, b = low + 0.382 * (high - low), low + 0.618 * (high - low)
        low, high = (low, b) if mismatch(a) < mismatch(b) else (a, high)
    return round((low + high) / 2, 4), mismatch


def draw_fig05(actor, decoder, weight):
    """Fig 5, WEDIS: predicted (top) and executed (bottom) skills; speed and direction at H_z = 100, T = 1, curvature at 40, 5."""
    figure, axes = plt.subplots(2, 3, figsize=(9.5, 6.4))
    for column, (name, axis, steps, hold) in enumerate([("speed", 0, 1, 100), ("direction", 1, 1, 100), ("curvature", 2, 5, 40)]):
        z = traversal(axis, list(common.LATENT_COLOURS))
        predicted = np.pad(hold * STEP_SCALE * predict(decoder, z, steps).numpy().cumsum(1), ((0, 0), (1, 0), (0, 0)))
        executed = paths(actor, z, steps, hold, weight)
        for i, (value, colour) in enumerate(common.LATENT_COLOURS.items()):
            axes[0, column].plot(*predicted[i].T, "o-", ms=3, color=colour, label=f"{value:g}")
            axes[1, column].plot(*executed[i].T, color=colour)
            axes[1, column].plot(*executed[i, ::hold].T, "o", ms=3, color=colour)
        axes[0, column].set(title=f"z_{name}, $H_z$ = {hold}, T = {steps}")
        axes[1, column].set(xlabel="x (m)")
        both = np.concatenate([predicted.reshape(-1, 2), executed.reshape(-1, 2)])
        for axis_ in axes[:, column]:  # one scale for both rows, or the eye is fooled
            axis_.set(xlim=(both[:, 0].min() - 1, both[:, 0].max() + 1), ylim=(min(-3, both[:, 1].min() - 1), max(3, both[:, 1].max() + 1)))
            axis_.set_aspect("equal")
    axes[0, 0].set_ylabel("predicted by the decoder\ny (m)")
    axes[1, 0].set_ylabel("executed by the Ant\ny (m)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), title="latent", loc="outside right upper")
    save_figure(figure, OUT, "fig05_skills_wedis" + ("" if EXPERIMENT == "ant_semi" else f"_{EXPERIMENT}"))


def draw_learning_curve(curve):
    figure, (error, returns) = plt.subplots(1, 2, figsize=(8, 3))
    minutes = [row["minutes"] for row in curve]
    error.plot(minutes, [row["tracking_error"] for row in curve], ".-", color=common.BLUE)
    error.set(xlabel="minutes on two cores", ylabel="tracking error (25 skills)", ylim=(0, 1.1))
    for name, colour in (("slow", common.GREY), ("mid", common.RED), ("fast", common.BLUE)):
        returns.plot(minutes, [row["speed_" + name] for row in curve], ".-", color=colour, label=name)
    returns.axhline(1, color="black", lw=0.8, ls="--")
    returns.set(xlabel="minutes on two cores", ylabel="achieved / commanded speed", ylim=(-0.1, 1.3))
    returns.legend()
    save_figure(figure, OUT, f"learning_curve_{EXPERIMENT}")


# ---------------------------------------------------------------- training

def train(decoder, config):
    """Algorithm 1, policy training. Returns what the policy artifact holds."""
    rng = np.random.default_rng(SEED)
    torch.manual_seed(SEED)
    robots = Robots(ant_spec(), ROBOTS, THREADS)
    s_dim, a_dim, z_dim = robots.observe().shape[1], robots.ctrl.shape[1], 2
    actor, critics = Actor(s_dim, z_dim, a_dim, HIDDEN), Critics(s_dim + z_dim + a_dim)
    value, target = value_network(s_dim + z_dim), value_network(s_dim + z_dim).requires_grad_(False)
    target.load_state_dict(value.state_dict())
    networks = nn.ModuleList([actor, critics, value])
    optimizer = torch.optim.Adam(networks.parameters(), lr=LEARNING_RATE, fused=True)

    columns = (s_dim, a_dim, s_dim, 2, z_dim)  # s, a, s', displacement, z; one row a step, so that one gather makes a batch
    replay = torch.zeros(REPLAY, sum(columns))
    z = torch.randn(ROBOTS, z_dim)
    age = rng.integers(0, EPISODE, ROBOTS)  # staggered, or all robots would start anew at once
    updates = env_steps = unstable = 0
    seconds, curve = 0.0, []
    robots.reset(np.arange(ROBOTS), rng)

    if resumable(OUT, "policy-checkpoint", EXPERIMENT, SEED, RESUME):
        state = load(OUT, "policy-checkpoint", EXPERIMENT, SEED)
        check_same(state, config, set(config) - {"RESUME", "OUT", "THREADS", "CHECKPOINT", "REPORTS", "UPDATES", "POLISH", "MINUTES"})
        networks.load_state_dict(state["networks"])
        target.load_state_dict(state["target"])
        optimizer.load_state_dict(state["optimizer"])
        replay[:len(state["replay"])] = state["replay"]
        z, age = state["z"], state["age"].numpy()
        updates, env_steps, unstable, seconds, curve = (state[k] for k in ("updates", "env_steps", "unstable", "seconds", "curve"))
        for name, view in state["robots"].items():
            robots.batch.bind(name)[:] = view.numpy()
        torch.set_rng_state(state["torch_rng"])
        rng.bit_generator.state = state["numpy_rng"]

    def checkpoint():
        save(OUT, "policy-checkpoint", EXPERIMENT, SEED, config, networks=networks.state_dict(), target=target.state_dict(),
             optimizer=optimizer.state_dict(), replay=replay[:min(env_steps, REPLAY)].clone(), z=z, age=torch.from_numpy(age),
             updates=updates, env_steps=env_steps, unstable=unstable, seconds=seconds, curve=curve, torch_rng=torch.get_rng_state(),
             robots={k: torch.from_numpy(robots.batch.bind(k).copy()) for k in ("qpos", "qvel", "ctrl", "time", "qacc_warmstart")},
             numpy_rng=rng.bit_generator.state)

    def report():
        error, degrees, ratio = tracking(*grid_run(actor, decoder)[:2])
        curve.append(dict(updates=updates, env_steps=env_steps, minutes=seconds / 60, tracking_error=float(error), reward=r.mean().item(),
                          direction_deg=float(degrees[2:].mean()), speed_slow=float(ratio[:2].mean()), speed_mid=float(ratio[2]),
                          speed_fast=float(ratio[3:].mean())))
        update_csv(Path(OUT) / "results" / f"learning_curve_{EXPERIMENT}_seed{SEED}.csv", curve, ())
        print(f"{updates:7d} updates {env_steps:8d} steps  tracking error {error:.3f}  direction {degrees[2:].mean():5.1f} deg  speed x "
              f"{ratio[:2].mean():.2f} {ratio[2]:.2f} {ratio[3:].mean():.2f}  reward {r.mean():6.3f}  floor {floor:.3f}  "
              f"{updates / seconds:4.0f} updates/s  {seconds / 60 * (1 / progress - 1):4.0f} min left", flush=True)

    def share_done():
        return seconds / 60 / MINUTES if MINUTES else updates / (UPDATES + POLISH)

    progress, last_save, interval = share_done(), time.time(), max(1, UPDATES // REPORTS)
    while progress < 1:
        clock, before = time.time(), updates
        # Collect: one step of every robot
        fresh = age % SKILL_STEPS == 0
        z[fresh] = torch.randn(int(fresh.sum()), z_dim)  # Alg. 1: sample z_single from the prior
        s = robots.observe()
        if env_steps < WARM_UP:
            a = torch.rand(ROBOTS, a_dim) * 2 - 1
        else:
            with torch.no_grad():
                a, _ = actor(actor.inputs(s, z))
        displacement, failed = robots.step(a.numpy())
        keep = torch.from_numpy(np.flatnonzero(~failed))
        rows = torch.cat([s, a, robots.observe(), displacement, z], 1)[keep]
        replay[torch.arange(env_steps, env_steps + len(rows)) % REPLAY] = rows
        env_steps += len(rows)
        unstable += int(failed.sum())
        age += 1
        if len(over := np.flatnonzero((age >= EPISODE) | failed)):
            robots.reset(over, rng)
            age[over] = 0
        if env_steps < WARM_UP:
            seconds += time.time() - clock
            continue
        if not updates:  # state statistics of the random steps, kept from here on
            first = replay[:env_steps, :s_dim]
            actor.s_mean.copy_(first.mean(0)), actor.s_std.copy_(first.std(0).clamp(min=1e-3))

        # Improve: a few updates
        for _ in range(UPDATES_PER_STEP):
            progress = share_done()
            main = progress * (UPDATES + POLISH) / UPDATES
            rate, temperature = (min(1, 2 * (1 - main)), TEMPERATURE) if main < 1 else (2 * (1 - progress), TEMPERATURE_END)
            floor = FLOOR_START * (FLOOR_END / FLOOR_START) ** min(1, max(0, (main - 0.5) / 0.4))
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * max(0, rate)
            batch = replay[torch.randint(min(env_steps, REPLAY), (BATCH,))]
            s, a, s2, displacement, skill = batch.split(columns, 1)
            skill[:int(RELABELLED * BATCH)] = torch.randn(int(RELABELLED * BATCH), z_dim)  # a copy: replay keeps its own
            with torch.no_grad():
                r = reward(decoder, skill, displacement, floor)
            losses = sac_losses(actor, critics, value, target, actor.inputs(s, skill), a, actor.inputs(s2, skill), r, temperature)
            optimizer.zero_grad()
            sum(losses).backward()  # the three touch disjoint parameters
            optimizer.step()
            torch._foreach_lerp_(list(target.parameters()), list(value.parameters()), SMOOTHING)
            updates += 1
        seconds += time.time() - clock
        progress = share_done()

        for name, metric in zip(("actor loss", "critic loss", "value loss", "reward"), (*losses, r.mean())):
            if not math.isfinite(metric.item()):
                stop(f"{name} is {metric.item()} after {updates} updates; nothing was overwritten: go on from the last good "
                     f"{artifact_name('policy-checkpoint', EXPERIMENT, SEED)} with --resume true, or lower --learning_rate", code=1)
        if updates // interval > before // interval or progress >= 1:
            report()
            if time.time() - last_save > 60 * CHECKPOINT:
                checkpoint()
                last_save = time.time()
    checkpoint()
    if unstable:
        print(f"{unstable} steps were unstable in MuJoCo: those robots were reset, the steps thrown away")
    return dict(actor=actor.state_dict(), curve=curve, updates=updates, env_steps=env_steps, seconds=seconds)


if __name__ == "__main__":
    config = parse_flags(globals())
    torch.set_num_threads(THREADS)
    decoder_content = load(OUT, "wetvae", DECODER, DECODER_SEED)
    decoder = load_decoder(decoder_content)
    weight, mismatch = calibrate_relation(decoder)
    if TRAIN:
        if not BATCH <= WARM_UP <= REPLAY or not UPDATES:
            stop(f"--updates must be at least 1 and --warm_up {WARM_UP} must lie between --batch {BATCH} and --replay {REPLAY}")
        trained = train(decoder, config)
        save(OUT, "policy", EXPERIMENT, SEED, config, decoder=decoder_content["decoder"], relation_weight=weight, **trained)
    policy = load(OUT, "policy", EXPERIMENT, SEED)
    actor = load_actor(policy)

    print(f"\nrelation function, calibrated: f_dir(z_dir, z_cur) = z_dir {weight:+.3f} z_cur   (the paper, by hand: 0.2 in size)")
    print(f"  heading of the decoder missed by {mismatch(weight):.1f} deg RMS; with 0.2 by {mismatch(0.2):.1f}, without by {mismatch(0.0):.1f}")
    z = traversal(2, np.linspace(-1.5, 1.5, 13))
    predicted = 40 * STEP_SCALE * predict(decoder, z, 5).numpy().sum(1)
    for w in (weight, 0.2, 0.0):
        miss, size = (np.linalg.norm(v, axis=1).mean() for v in (paths(actor, z, 5, 40, w)[:, -1] - predicted, predicted))
        print(f"  on the Ant (T = 5, H_z = 40): weight {w:.3f} ends {miss:.2f} m from the decoder's curve of {size:.1f} m")

    executed, commanded, flipped = grid_run(actor, decoder)
    error, degrees, ratio = tracking(executed, commanded)
    torch.manual_seed(SEED)
    error_sampled, *_ = tracking(*grid_run(actor, decoder, deterministic=False)[:2])
    names = list(FULL_RANGE)
    curves = [factors_of(np.diff(paths(actor, traversal(i, np.linspace(-1.5, 1.5, 13)), 5, 40, weight)[:, ::40], axis=1) / (40 * STEP_SCALE))
              for i in range(3)]
    C, purity = cross_talk(curves, names)
    skills = nn.functional.pad(torch.randn(COVERAGE, 2), (0, 1))
    coverage = len(np.unique(np.floor(paths(actor, skills, 1, EPISODE, 0.0).reshape(-1, 2)), axis=0))
    print(f"\ntracking error {error:.3f} (mean actions), {error_sampled:.3f} (sampled actions); flips {flipped.sum()} of 25")
    print("z_speed              -1.5  -0.75      0   0.75    1.5")
    print("direction error deg " + " ".join(f"{d:6.1f}" for d in degrees))
    print("achieved/commanded  " + " ".join(f"{v:6.2f}" for v in ratio))
    print("executed cross-talk, purity: " + "; ".join(f"z_{n} " + " ".join(f"{c:.2f}" for c in row) + f" purity {p:.2f}"
                                                       for n, row, p in zip(names, C, purity)))
    print(f"coverage of {COVERAGE} random skills: {coverage} cells of 1 m")
    update_csv(Path(OUT) / "results" / "policies.csv", [dict(
        experiment=EXPERIMENT, method=METHOD, robot=ROBOT, seed=SEED, updates=policy["updates"], env_steps=policy["env_steps"],
        train_minutes=policy["seconds"] / 60, tracking_error=error, tracking_error_sampled=error_sampled,
        direction_error_deg=degrees[2:].mean(), speed_ratio_slow=ratio[:2].mean(), speed_ratio_mid=ratio[2],
        speed_ratio_fast=ratio[3:].mean(), flips=int(flipped.sum()), purity_speed=purity[0], purity_direction=purity[1],
        purity_curvature=purity[2], purity_acceleration="", coverage_cells=coverage)], ("experiment", "method", "seed"))
    draw_fig05(actor, decoder, weight)
    draw_learning_curve(policy["curve"])

"""Stage 3: decoder -> skill policy pi(a | s, z_single), trained by SAC on single steps (Sec. 4.2, App. A.1.3); and the baselines of Fig 5
and 7, DADS and SeCTAR, by the same loop: a method is where skills come from, what a transition is worth, and what else learns.

Reads runs/wetvae_*.pt. The reward is the decoder's log-likelihood of the step just made (Eq. 6), computed when a batch is
sampled, so that any stored step can be relabelled with a fresh skill. Writes runs/policy_<experiment>_seed<seed>.pt,
Fig 5 (15, 16), the learning curve (figures/, results/) and a row of results/policies.csv.
Takes 55 minutes on one core (49 updates/s; AMD EPYC 7003, no AVX-512), 41 on two with --threads 2. Expect, n = 3 (seeds 0, 1, 2): tracking
error 0.13, 0.12, 0.11 with mean actions (0.16, 0.12, 0.22 before calibration), direction error 4, 3, 3 degrees, speeds at 0.92 to 1.11 of
those asked, no flips.
"""
import copy
import math
import time
from itertools import combinations, permutations
from pathlib import Path

import common  # before mujoco: it chooses how mujoco renders
from common import (EXPLORER, FASTEST, Actor, Decoder, Robots, SkillDynamics, ant_spec, artifact_name, check_same, cross_talk, egocentric, execute,
                    factors_of, first_step, load, load_actor, load_decoder, parse_flags, plt, predict, read_csv, resumable, save, save_figure, stop,
                    update_csv)
import mujoco
import numpy as np
import torch
from torch import nn

EXPERIMENT = "ant_semi"  # row of EXPERIMENTS below
SEED = 0                 # random seed
OUT = "."                # folder for runs/, figures/ and results/
TRAIN = True             # false: only measure and draw what is already trained
RESUME = False           # true: continue from the last checkpoint
THREADS = 1              # CPU threads; two trainings on one each make half as many updates again as one on two
UPDATES = 160_000        # SAC updates; the schedules below run over them (the paper: 1.92 million)
MINUTES = 0.0            # if not 0, the schedules run out with this clock instead, whatever UPDATES says
CHECKPOINT = 5.0         # minutes between checkpoints, which are made after a report
REPORTS = 40             # printed lines and points of the learning curve

DECODER = "main"         # experiment of 02 whose decoder is the reward
DECODER_SEED = 0         # and its seed
TAKEN = ""               # experiment whose egocentric policy is taken as it is, told the steps of this decoder ("": train)
METHOD = "wedis"         # wedis, dads or sectar
ROBOT = "ant"            # ant or half_cheetah
STEP_SCALE = 0.1         # metres per trajectory unit, App. A.1.3: 1/10, Half-Cheetah 1/5
DIRECTIONS = 5           # of the tracking grid: from -1.5 to 1.5 of z_dir
AXES = 3                 # entries of z: speed, direction, curvature; Half-Cheetah 2, DADS 2, SeCTAR 8
Z_RANGE = 1.5            # ends of a traversed axis
HOLD = 100               # H_z of the tracking error
LENGTH = 1               # T of the tracking error
PROFILE = 40             # H_z at which executed factors are measured, T = 5

ROBOTS = 64              # environments that step together
EPISODE = 200            # steps until a robot starts anew; not terminal: the value beyond is bootstrapped
SKILL_STEPS = 100        # steps until a robot is given a new skill
WARM_UP = 10_000         # steps with random actions; their statistics normalise the state
REPLAY = 1_000_000       # steps kept
UPDATES_PER_STEP = 8     # updates after each step of all robots
BATCH = 256              # App. A.1.3
RELABELLED = 0.5         # share of a batch given a fresh skill from the prior (hindsight)

EGOCENTRIC = True        # the networks see state and wanted step from the torso, up to quarter turns (false: s and z, the paper)
HIDDEN = 256             # width of the two hidden layers (the paper: 512)
LEARNING_RATE = 1e-3     # Adam (the paper: 3e-4, fixed)
DECAY_FROM = 0.5         # share of the updates after which the learning rate falls linearly to 0; 1: never
AVERAGED = 0.002         # rate of the average over the actor's weights that is measured and kept; 1: the actor itself
DISCOUNT = 0.97          # gamma of Eq. 1 (the paper: 0.99)
SMOOTHING = 0.01         # of the target value network, App. A.1.3
REWARD_SCALE = 0.1       # the paper: 1
TEMPERATURE = 0.003      # alpha, weight of the entropy (the paper: 0.01, which is 0.001 at our reward scale)
VARIANCE_SCALE = 0.05    # decoder variance -> square metres, App. A.1.3: 1/20
FLOOR_START = 0.04       # metres, least standard deviation of the reward: a sharp one makes standing still a trap
FLOOR_END = 0.01         # shrinks to this between 0.15 and 0.6 of the updates: teaches the slow skills

RECENT = 0               # latest steps that a baseline's model learns from, once in UPDATES_PER_STEP updates
MODEL_BATCH = 0          # steps (DADS) or trajectories (SeCTAR) in a batch of theirs
PRIOR_SAMPLES = 100      # L of DADS's reward
MOMENTS = 0.02           # rate of the running mean and deviation that normalise DADS's targets
EXPLORE = 0.5            # SeCTAR: share of trajectories that are the explorer's (0: no explorer)
KL_WEIGHT = 2.0          # SeCTAR
CLONING = 0.1            # SeCTAR: weight of behaviour cloning (published: 100; the mean of many lively actions is standing still)
VAE_SCALE = 0.01         # of SeCTAR's loss beside SAC's; Adam does not notice, but for the actor: cloning against reward

CALIBRATED = 4           # rounds of calibrating the steps that an egocentric policy is told; 0: none (the paper)
CALIBRATORS = 384        # robots that walk an episode in each
SPEEDS = 16              # of a wanted step,
ANGLES = 9               # and its angles from the torso's heading, at which it is corrected
SELDOM = 50.0            # added to the visits that a correction has in a round: what is seldom met hardly changes
GAIN_DECAY = 0.7         # the k-th round's misses count k ** -GAIN_DECAY: noise averages out
TRAVERSAL = 13           # skills on each axis at which executed purity and the relation function are measured
STARTS = 32              # noisy starts over which an executed skill is averaged for its purity: fewer, and their noise counts as cross-talk
COVERAGE = 200           # random skills whose visited cells of 1 m are counted at the end

EXPERIMENTS = {  # a row names the constants in which an experiment differs from the ones above
    "ant_semi": {},
    "ant_full": dict(DECODER="full_circle", DIRECTIONS=16, TAKEN="ant_semi"),                                          # Fig 15
    "half_cheetah": dict(DECODER="speed_acc", ROBOT="half_cheetah", STEP_SCALE=0.2, EGOCENTRIC=False, AXES=2,                 # Fig 16
                         UPDATES=100_000),
    # the baselines train by the clock
    "ant_dads": dict(METHOD="dads", AXES=2, Z_RANGE=1.0, SKILL_STEPS=200, RECENT=10_000, MODEL_BATCH=256, MINUTES=45.0),
    "ant_sectar": (SECTAR := dict(METHOD="sectar", AXES=8, LENGTH=50, HOLD=1, PROFILE=10, SKILL_STEPS=50, RECENT=128_000,
                                  MODEL_BATCH=128, REWARD_SCALE=0.3, MINUTES=45.0)),
    "ant_sectar_no_explorer": SECTAR | dict(EXPLORE=0.0),  # what the explorer is good for
}
FACTORS = dict(speed=1.0, direction=2 * math.pi, curvature=math.pi / 3)  # of which the baselines' axes know nothing: full ranges, Table 1


def half_cheetah_spec():
    """The Half-Cheetah of the MuJoCo benchmarks (6 hinges on a rail), built in code. nq 9, nv 9, nu 6, Euler at 0.01 s."""
    spec = mujoco.MjSpec()
    spec.modelname, spec.compiler.degree = "cheetah", False
    spec.option.timestep = 0.01
    joint, geom = spec.default.joint, spec.default.geom
    joint.armature, joint.limited, joint.solimp_limit[:3], joint.solref_limit = 0.1, True, [0, 0.8, 0.03], [0.02, 1]
    geom.condim, geom.conaffinity, geom.friction, geom.solimp[:3], geom.rgba = 3, 0, [0.4, 0.1, 0.1], [0, 0.8, 0.01], [0.8, 0.6, 0.4, 1]
    geom.density = 660.8849500774735  # 14 kg in all

    def capsule(body, name, x, z, angle, half_length):
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.046, half_length, 0], pos=[x, 0, z],
                      quat=[math.cos(angle / 2), 0, math.sin(angle / 2), 0])

    spec.worldbody.add_light(pos=[0, 0, 1.3], dir=[0.2, 0.4, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[40, 40, 40], conaffinity=1, rgba=[0.85, 0.88, 0.85, 1])
    torso = spec.worldbody.add_body(name="torso", pos=[0, 0, 0.7])
    for name, kind, axis in (("rootx", "SLIDE", [1, 0, 0]), ("rootz", "SLIDE", [0, 0, 1]), ("rooty", "HINGE", [0, 1, 0])):
        torso.add_joint(name=name, type=getattr(mujoco.mjtJoint, f"mjJNT_{kind}"), axis=axis, armature=0, limited=False)
    torso.add_geom(name="torso", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[-0.5, 0, 0, 0.5, 0, 0], size=[0.046, 0, 0])
    capsule(torso, "head", 0.6, 0.1, 0.87, 0.15)
    for part in (  # name, position, joint: range, stiffness, damping; geom: x, z, angle, half length; gear
            [("bthigh", [-0.5, 0, 0], [-0.52, 1.05], 240, 6, (0.1, -0.13, -3.8, 0.145), 120),
             ("bshin", [0.16, 0, -0.25], [-0.785, 0.785], 180, 4.5, (-0.14, -0.07, -2.03, 0.15), 90),
             ("bfoot", [-0.28, 0, -0.14], [-0.4, 0.785], 120, 3, (0.03, -0.097, -0.27, 0.094), 60)],
            [("fthigh", [0.5, 0, 0], [-1, 0.7], 180, 4.5, (-0.07, -0.12, 0.52, 0.133), 120),
             ("fshin", [-0.14, 0, -0.24], [-1.2, 0.87], 120, 3, (0.065, -0.09, -0.6, 0.106), 60),
             ("ffoot", [0.13, 0, -0.18], [-0.5, 0.5], 60, 1.5, (0.045, -0.07, -0.6, 0.07), 30)]):
        body = torso
        for name, pos, bend, stiffness, damping, shape, gear in part:
            body = body.add_body(name=name, pos=pos)
            body.add_joint(name=name, axis=[0, 1, 0], range=bend, stiffness=[stiffness, 0, 0], damping=[damping, 0, 0])
            capsule(body, name, *shape)
            motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrllimited=True, ctrlrange=[-1, 1])
            motor.set_to_motor()
            motor.gear[0] = gear
    return spec


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


def reward(mean, log_var, displacement, floor):
    """Eq. 6 for one step: log p(displacement | z_single, z_multi = 0) minus its value at the decoder's mean, (B,).

    mean, log_var (B, 2) of the decoder, displacement (B, 2) in metres, floor in metres. The subtracted term depends on z only: same objective."""
    variance = (VARIANCE_SCALE * log_var.exp()).clamp(min=floor ** 2)
    return REWARD_SCALE * -0.5 * ((displacement - STEP_SCALE * mean) ** 2 / variance).sum(1)


class Wedis:
    """Skills from the prior; a step is worth the decoder's log-likelihood (Eq. 6); the decoder is trained already."""
    model, metric = nn.ModuleDict(), None

    def __init__(self, decoder):
        self.decoder, self.z_dim, self.span = decoder, AXES - 1, 1  # span: steps that are judged together

    def sample(self, n):
        return torch.randn(n, self.z_dim)

    def reward(self, displacement, t, z, floor):
        step, log_var = first_step(self.decoder, z)
        return reward(step, log_var, displacement[:, 0], floor), step, step

    def loss(self, s, a, displacement, z, actor):
        return torch.zeros(())


class Dads:
    """Sharma et al. 2019. Skills z ~ U(-1, 1)^2; a step is worth its mutual information with z under q(displacement | z); q learns.

    The reward is computed anew for each batch, with the q of now, so that old steps and relabelled ones can be used (off-policy DADS)."""
    metric = "mutual information (nats)"

    def __init__(self):
        self.decoder, self.z_dim, self.span = SkillDynamics(AXES), AXES, 1
        self.model = nn.ModuleDict(dict(decoder=self.decoder))

    def sample(self, n):
        return torch.rand(n, self.z_dim) * 2 - 1

    def information(self, displacement, z):
        """log(L + 1) - log(1 + sum_i exp(log q(.|z_i) - log q(.|z))), (B,), of displacements (B, 2) in metres. The L prior samples are
        the same for all B: q reads z alone, so that they cost L evaluations and not L B."""
        x = (displacement / STEP_SCALE - self.decoder.x_mean) / self.decoder.x_std
        own = self.decoder.log_prob(x, *self.decoder.mixture(z))
        others = self.decoder.log_prob(x[:, None], *self.decoder.mixture(self.sample(PRIOR_SAMPLES)))
        return math.log(PRIOR_SAMPLES + 1) - (1 + (others - own[:, None]).clamp(-50, 50).exp().sum(1)).log()

    def reward(self, displacement, t, z, floor):
        return REWARD_SCALE * self.information(displacement[:, 0], z), z, z

    def loss(self, s, a, displacement, z, actor):
        """-log q of recent steps under the skills that made them (never under relabelled ones: q would learn that z means nothing)."""
        x = displacement[:, 0] / STEP_SCALE
        self.decoder.x_mean.lerp_(x.mean(0), MOMENTS), self.decoder.x_std.lerp_(x.std(0), MOMENTS)  # q's unit deviation is in these units
        return -self.decoder.log_prob((x - self.decoder.x_mean) / self.decoder.x_std, *self.decoder.mixture(z[:, 0])).mean()

    def measure(self, displacement, z):
        return self.information(displacement[:, 0], z[:, 0]).mean().item()


class Encoder(nn.Module):
    """q_phi(z | tau) of SeCTAR: a bidirectional LSTM over displacements (B, T, 2), mean-pooled. Returns mean, log-variance (B, AXES)."""

    def __init__(self, hidden=64):
        super().__init__()
        self.lstm, self.head = nn.LSTM(2, hidden, bidirectional=True, batch_first=True), nn.Linear(2 * hidden, 2 * AXES)

    def forward(self, x):
        return self.head(self.lstm(x)[0].mean(1)).chunk(2, 1)


class Sectar:
    """Co-Reyes et al. 2018. Skills z ~ N(0, I) for SKILL_STEPS steps, worth the likelihood of ending where the state decoder says. Encoder,
    state decoder and, by cloning, the policy learn from the explorer's trajectories. The explorer is the same policy, told EXPLORER
    instead of a skill, and worth what the VAE cannot reconstruct; skills begin where it ends, and both learn from both's trajectories."""
    metric = "reconstruction error"

    def __init__(self):
        self.decoder, self.encoder, self.z_dim, self.span = Decoder(AXES), Encoder(), AXES, SKILL_STEPS
        self.model = nn.ModuleDict(dict(decoder=self.decoder, encoder=self.encoder))

    def sample(self, n):
        return torch.where(torch.rand(n, 1) < EXPLORE, self.explorers(n), torch.randn(n, self.z_dim))

    def explorers(self, n):
        """What tells the policy to explore, (n, AXES): a step that is far too long, anywhere, and a mark."""
        return nn.functional.pad(EXPLORER * nn.functional.normalize(torch.randn(n, 2)), (0, self.z_dim - 2), value=EXPLORER)

    def posterior(self, x):
        """Displacements x (B, T, 2) in trajectory units -> a sample of q(z | tau) (B, AXES), its KL divergence from the prior (B,)."""
        mean, log_var = self.encoder(x)
        return mean + (0.5 * log_var).exp() * torch.randn_like(mean), 0.5 * (mean ** 2 + log_var.exp() - 1 - log_var).sum(1)

    def decode(self, z):
        """Mean and log-variance (B, SKILL_STEPS, 2) in trajectory units. Without a floor the likelihood of standing still has no bound."""
        mean, log_var = self.decoder.unroll(z, SKILL_STEPS)
        return mean, log_var.clamp(min=2 * math.log(FLOOR_END / STEP_SCALE))

    def reward(self, displacement, t, z, floor):
        """displacement (K, T, 2) of whole trajectories, t (n, K): the steps of each that are asked for, z (K, AXES) -> (n K,), and
        what the policy is told at t and after it (n K, 2). No floor: a place, unlike a step, does not tremble."""
        x, explorer, i, told = displacement / STEP_SCALE, z[:, -1] == EXPLORER, torch.arange(len(z)), z
        if explorer.any():
            z = z.clone()
            z[explorer], _ = self.posterior(x[explorer])
        mean, _ = self.decode(z)
        steps, miss = torch.where(explorer[:, None, None], told[:, None, :2], mean), x - mean
        # how far from the decoded place a trajectory ends (a Laplace likelihood of the place), shared among its steps; by single steps
        # a skill would be paid for not trembling, which is standing still, and the explorer for trembling
        away = (miss * nn.functional.normalize(miss.sum(1))[:, None]).sum(2)[i, t]
        r = REWARD_SCALE * torch.where(explorer, away, -away)
        return r.flatten(), *(steps[i, u].flatten(0, 1) for u in (t, (t + 1).clamp(max=SKILL_STEPS - 1)))

    def elbo(self, x):
        """Displacements (B, T, 2) in trajectory units -> sum_t log p(x_t | z), KL(q || p), both (B,), and the decoded means (B, T, 2)."""
        z, kl = self.posterior(x)
        mean, log_var = self.decode(z)
        return -0.5 * (log_var + math.log(2 * math.pi) + (x - mean) ** 2 / log_var.exp()).sum((1, 2)), kl, mean

    def loss(self, s, a, displacement, z, actor):
        """Negative ELBO of the explorer's recent trajectories (without one: of all) and cloning of eight actions of each, by the policy told
        what is decoded from q's z. Skills that stand still would teach the prior to stand still."""
        mine = (z[:, 0, -1] == EXPLORER) | (EXPLORE == 0)
        log_p, kl, steps = self.elbo(displacement / STEP_SCALE)
        i, t = torch.arange(len(s))[:, None], torch.randint(SKILL_STEPS, (len(s), 8))
        x, turns = actor.inputs(s[i, t].flatten(0, 1), None, steps[i, t].flatten(0, 1))
        action, _ = actor(x, deterministic=True)
        miss = 0.5 * ((action - actor.seen(a[i, t].flatten(0, 1), turns)) ** 2).sum(1).view(-1, 8).mean(1)
        return VAE_SCALE * ((KL_WEIGHT * kl - log_p + CLONING * miss) * mine).sum() / mine.sum().clamp(min=1)

    def reconstruction_error(self, x):
        """Displacements (B, T, 2) in trajectory units -> RMS over all places of (decoded from q's mean - executed) / RMS executed."""
        path = x.cumsum(1)
        return ((self.decode(self.encoder(x)[0])[0].cumsum(1) - path).square().mean() / path.square().mean()).sqrt().item()

    def measure(self, displacement, z):
        return self.reconstruction_error(displacement / STEP_SCALE)


METHODS = dict(wedis=Wedis, dads=Dads, sectar=Sectar)


def trajectories(n, span, env_steps, replay, recent):
    """Rows of replay (n, span) of n random trajectories of `span` steps, complete ones among the `recent` latest steps. A step of all
    robots is ROBOTS rows, so a robot's next step is ROBOTS rows on; trajectories begin together (or span is 1)."""
    block = ROBOTS * span
    done, kept = env_steps // block, len(replay) // block
    back = torch.randint(max(1, min(done, kept - 1, recent // block)), (n,))  # kept - 1: one is being overwritten
    return (((done - 1 - back) % kept * block + torch.randint(ROBOTS, (n,)))[:, None] + ROBOTS * torch.arange(span))


def sac_losses(actor, critics, value, target, x, a, x2, r):
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
    actor_loss = (TEMPERATURE * log_prob - (slope * a_new).sum(1)).mean()
    v_loss = 0.5 * ((value(x).squeeze(1) - (q_new - TEMPERATURE * log_prob).detach()) ** 2).mean()
    return actor_loss, q_loss, v_loss


# ---------------------------------------------------------------- measuring

def make_robots(n):
    return Robots(ant_spec() if ROBOT == "ant" else half_cheetah_spec(), n, THREADS)


def grid():
    """DESIGN's tracking grid. Ant: 5 speeds x DIRECTIONS in [-1.5, 1.5] (a full circle's ends are one direction), (n, 3);
    Half-Cheetah: 8 speeds in [-1, 1] (Fig 16), (8, 2). DADS: 5 x 5 in its square; SeCTAR, of eight axes: 25 fixed draws from the prior."""
    if METHOD != "wedis":
        return (torch.cartesian_prod(*[torch.linspace(-1, 1, 5)] * 2) if METHOD == "dads" else
                torch.randn(25, AXES, generator=torch.Generator().manual_seed(0)))
    if ROBOT != "ant":
        return nn.functional.pad(torch.linspace(-1, 1, 9)[torch.arange(9) != 4][:, None], (0, 1))
    directions = torch.linspace(-1.5, 1.5, DIRECTIONS) if EXPERIMENT != "ant_full" else 3 * torch.arange(DIRECTIONS) / DIRECTIONS - 1.5
    return nn.functional.pad(torch.cartesian_prod(torch.linspace(-1.5, 1.5, 5), directions), (0, 1))


def walk(actor, z, steps, hold, weight, deterministic=True, noise=None, run_in=0):
    """Skills z (n, M) executed: all poses (n, steps * hold + 1, nq). From rest, or with noise, a generator, from noisy starts; recorded after
    a run-in (from rest the first step is short and looks like acceleration)."""
    robots = make_robots(len(z))
    if noise is not None:
        robots.reset(np.arange(len(z)), noise)
    for _ in execute(actor, robots, z, 1, run_in, weight, deterministic):
        pass
    return np.stack([robots.qpos.copy(), *(robots.qpos.copy() for _ in execute(actor, robots, z, steps, hold, weight, deterministic))], 1)


def paths(*skills, **how):
    """The places of walk, (n, steps * hold + 1, 2 or 1) in metres."""
    return walk(*skills, **how)[..., :2 if ROBOT == "ant" else 1]


def grid_run(actor, decoder, deterministic=True):
    """The tracking grid walked from rest for LENGTH skills' steps T of HOLD steps H_z. Returns executed and predicted end points (n, 2 or
    1) in metres, of the baselines from the shortest prediction to the longest, and which robots were ever upside down (n,)."""
    z = grid()
    poses = walk(actor, z, LENGTH, HOLD, 0.0 if METHOD == "wedis" else None, deterministic)
    # the up-vector of the torso: its quaternion's x and y tell its height, 1 - 2 (x^2 + y^2); on a rail the pitch does
    up = 1 - 2 * (poses[..., 4:6] ** 2).sum(2) if ROBOT == "ant" else np.cos(poses[..., 2])
    predicted = (HOLD * STEP_SCALE * predict(decoder, z, LENGTH).sum(1)).double().numpy()
    order = slice(None) if METHOD == "wedis" else np.argsort((predicted ** 2).sum(1))
    return poses[order, -1, :predicted.shape[1]], predicted[order], (up < 0).any(1)


def tracking(executed, predicted):
    """Tracking error RMS(executed - predicted) / RMS(predicted). By speeds (Ant: five; Half-Cheetah: four sizes, both signs averaged), mean
    |direction error| in degrees (backwards is 180) and mean achieved / commanded distance along the commanded direction."""
    error = np.sqrt(((executed - predicted) ** 2).sum(1).mean() / (predicted ** 2).sum(1).mean())
    ratio = (executed * predicted).sum(1) / (predicted ** 2).sum(1)
    e, p = (v @ np.array([[1], [1j]])[:v.shape[1]] for v in (executed, predicted))
    turn = abs(np.angle(e / p, deg=True)[:, 0])
    if ROBOT != "ant":
        return error, *((v[3::-1] + v[4:])[:, None].mean(1) / 2 for v in (turn, ratio))
    return error, turn.reshape(5, -1).mean(1), ratio.reshape(5, -1).mean(1)


def by_speed(values):
    """Mean over the slow, the middle and the fast of what tracking returns by speed."""
    n = (len(values) - 1) // 2
    return [float(part.mean()) for part in np.split(values, [n, len(values) - n])]


def traversal(axis, values):
    """Skills with one axis at values, the others at 0; acceleration at z_speed = -1, because it is nothing where speed is."""
    z = torch.zeros(len(values), AXES)
    if ROBOT != "ant" and axis == 1:
        z[:, 0] = -1
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    return z


def calibrate_relation(decoder, steps=5):
    """The weight of the relation function (Sec. 4.2.2, next_skill) from the decoder alone: single steps at the skills the function
    visits against the steps of the decoder's free run, least squares over a grid of skills; the Ant's only where the headings
    stay within what was trained. Returns the weight and a function weight -> RMS miss as a share of the RMS step."""
    g = torch.linspace(-1.5, 1.5, 13)
    z = torch.cartesian_prod(torch.tensor([0.0, 0.75, 1.5]), g, g) if ROBOT == "ant" else torch.cartesian_prod(g / 1.5, g)
    free = predict(decoder, z, steps)
    inside = torch.ones(len(z), dtype=torch.bool)
    if EXPERIMENT == "ant_semi":
        inside = (torch.atan2(free[..., 1], free[..., 0]).abs() < math.radians(65)).all(1)

    def miss(weight):
        apart = predict(decoder, z, steps, weight)[inside] - free[inside]
        return (apart.square().mean() / free[inside].square().mean()).sqrt().item()

    low, high = -1.0, 1.0
    while high - low > 1e-4:  # golden section: the miss has one valley
        a, b = low + 0.382 * (high - low), low + 0.618 * (high - low)
        low, high = (low, b) if miss(a) < miss(b) else (a, high)
    return round((low + high) / 2, 4), miss


@torch.no_grad()
def calibrate_steps(actor):
    """Beyond the paper: the table (SPEEDS, ANGLES, 2) for actor.told with which the Ant makes on average the steps it is asked for.

    What it misses, ahead and to the left of the step, by the step's speed and its angle from the torso, is added to what it is told, and
    measured again, a little less each time (stochastic approximation). Episodes begin with noise; their first fifth is not counted."""
    rng, told = np.random.default_rng(SEED + 1), torch.zeros(SPEEDS * ANGLES, 2)
    for k in range(1, CALIBRATED + 1):
        actor.told = told.view(SPEEDS, ANGLES, 2)
        robots = make_robots(CALIBRATORS)
        robots.reset(np.arange(CALIBRATORS), rng)
        step = torch.polar(FASTEST * (torch.arange(CALIBRATORS) + 0.5) / CALIBRATORS, 2 * math.pi * torch.rand(CALIBRATORS))
        asked, back = torch.view_as_real(step), torch.polar(torch.ones(CALIBRATORS), -step.angle())  # back: turns the step ahead
        missed, visits = torch.zeros_like(told), torch.zeros(len(told))
        for t in range(EPISODE):
            s = robots.observe()
            displacement, failed = robots.step(actor.follow(s, asked, True).numpy())
            if t >= EPISODE // 5:
                miss = torch.view_as_real((step - torch.view_as_complex(displacement) / STEP_SCALE) * back)
                nodes, share = actor.nodes(s, asked)
                share[failed] = 0  # an unstable step means nothing
                missed.index_add_(0, nodes.flatten(), (share[..., None] * miss[:, None]).flatten(0, 1))
                visits.index_add_(0, nodes.flatten(), share.flatten())
        told = told + missed / (visits + SELDOM)[:, None] / k ** GAIN_DECAY
    return told.view(SPEEDS, ANGLES, 2)


def draw_skills(actor, decoder, weight, name, columns):
    """Fig 5, 15, 16: predicted (top) and executed (bottom) skills; a column per (axis, values, T, H_z). In one dimension the
    latent is on the y axis and time steps have colours."""
    figure, axes = plt.subplots(2, len(columns), figsize=((3.2 if len(columns) < 5 else 2.4) * len(columns), 6.4))
    for column, (title, axis, values, steps, hold) in enumerate(columns):
        z = traversal(axis, values)
        predicted = np.pad(hold * STEP_SCALE * predict(decoder, z, steps).numpy().cumsum(1), ((0, 0), (1, 0), (0, 0)))
        executed = paths(actor, z, steps, hold, weight)
        both = np.concatenate([predicted, executed], 1)
        if both.shape[2] == 1:
            for row, points in enumerate((predicted, executed[:, ::hold])):
                for t, colour in enumerate(plt.get_cmap("plasma")(np.linspace(0, 0.85, steps + 1))):
                    axes[row, column].plot(points[:, t, 0], values, ".", color=colour, label=f"t = {t}")
                axes[row, column].set(ylabel=title, xlim=(both.min() - 1, both.max() + 1))
        else:
            colours = plt.get_cmap("twilight_shifted" if len(values) > 5 else common.TRAVERSAL_MAP)(np.linspace(0, 0.95, len(values)))
            for i, value in enumerate(values):
                colour = common.LATENT_COLOURS[value] if len(values) == 5 else colours[i]
                axes[0, column].plot(*predicted[i].T, "o-", ms=3 if hold > 1 else 1, color=colour, label=f"{value:g}")
                axes[1, column].plot(*executed[i].T, color=colour)
                axes[1, column].plot(*executed[i, ::hold].T, "o", ms=3 if hold > 1 else 1, color=colour)
            low, high = both.min((0, 1)), both.max((0, 1))
            room = (high - low).max() / 8
            for ax in axes[:, column]:  # one scale for both rows, or the eye is fooled
                ax.set(xlim=(low[0] - room, high[0] + room), ylim=(min(-3 * room, low[1] - room), max(3 * room, high[1] + room)))
                ax.set_aspect("equal")
        axes[0, column].set(title=f"{title}, $H_z$ = {hold}, T = {steps}")
        if len(values) != len(columns[-1][2]):  # not the latents that the legend of the figure names
            axes[0, column].legend(title="latent", fontsize=7, loc="upper left", ncols=3, handlelength=1)
        axes[1, column].set(xlabel="x (m)")
    for row, text in enumerate(("predicted by the model", "executed by the robot")):
        axes[row, 0].set_ylabel(text + "\n" + (axes[row, 0].get_ylabel() or "y (m)"))
    last = axes[0, -1].get_legend_handles_labels()
    figure.legend(*last, title="latent" if both.shape[2] == 2 else "time step", loc="outside right upper")
    save_figure(figure, OUT, name)


def write_curve(curve):
    update_csv(Path(OUT) / "results" / f"learning_curve_{EXPERIMENT}_seed{SEED}.csv", curve, ())


def draw_learning_curve():
    """Tracking error and achieved speeds, of a baseline also its own metric, against the minutes of training; a line per seed."""
    curves = [read_csv(path) for path in sorted((Path(OUT) / "results").glob(f"learning_curve_{EXPERIMENT}_seed*.csv"))]
    own = "metric" in curves[0][0]
    figure, axes = plt.subplots(1, 2 + own, figsize=(8 + 4 * own, 3))
    for n, curve in enumerate(curves):
        column = {name: [float(row[name]) for row in curve] for name in curve[0]}
        for ax, names in zip(axes, (dict(tracking_error=common.BLUE), dict(speed_slow=common.GREY, speed_mid=common.RED, speed_fast=common.BLUE),
                                    dict(metric=common.BLUE))):
            for name, colour in names.items():
                ax.plot(column["minutes"], column[name], "-", lw=1.2, color=colour, label=name.removeprefix("speed_") if n == 0 else None)
    for ax, label in zip(axes, (f"tracking error ({len(grid())} skills)", "achieved / commanded speed", f"{METHODS[METHOD].metric}, recent steps")):
        ax.set(xlabel=f"minutes of training ({THREADS} thread{'s' * (THREADS > 1)}), {len(curves)} seed{'s' * (len(curves) > 1)}", ylabel=label)
    for ax, (low, high, least, most) in zip(axes, ((0, 1.1, 0, 3), (-0.1, 1.3, -1, 3))):  # a baseline's first skills can be far off
        ax.set_ylim(max(least, min(low, ax.get_ylim()[0])), min(most, max(high, ax.get_ylim()[1])))
    axes[1].axhline(1, color="black", lw=0.8, ls="--")
    axes[1].legend()
    save_figure(figure, OUT, f"learning_curve_{EXPERIMENT}")


def match(C):
    """Best one-to-one matching of axes (A, rows) to factors (columns) by the cross-talk: the pairs whose purities sum to most. Of fewer
    axes than factors some factors have none, of more each has its best. Returns {factor: (axis, purity)}, by number."""
    share, n = C / C.sum(1, keepdims=True), min(C.shape)
    axes, factors = max(((a, f) for a in permutations(range(len(C)), n) for f in combinations(range(C.shape[1]), n)),
                        key=lambda pairing: share[pairing].sum())
    return {f: (a, share[a, f]) for a, f in zip(axes, factors)}


def measure_baseline(actor, policy, method, skills):
    """What DADS and SeCTAR have beyond WEDIS's measures: {what: value}. skills (n, AXES), drawn from the prior."""
    for name, part in method.model.items():
        part.load_state_dict(policy[name])
    found = dict(metric_first=policy["curve"][0]["metric"], metric_last=policy["curve"][-1]["metric"])
    if METHOD == "dads":  # R^2: of what moves the robot, how much skill dynamics tell better than a constant
        track = paths(actor, skills, 1, EPISODE, None)
        for hold in (1, 20, HOLD):
            executed = np.diff(track[:, ::hold], axis=1)
            miss = executed - hold * STEP_SCALE * predict(method.decoder, skills, 1).numpy()
            found[f"r2_of_{hold}_steps"] = 1 - (miss ** 2).sum() / ((executed - executed.mean((0, 1))) ** 2).sum()
        return found
    for name, mean_actions in (("", True), ("_sampled", False)):  # new trajectories from rest: the VAE has never seen them
        track = paths(actor, skills, SKILL_STEPS, 1, None, mean_actions)
        executed = torch.from_numpy(np.diff(track, axis=1)).float() / STEP_SCALE
        found["reconstruction_error" + name] = method.reconstruction_error(executed)
        miss = predict(method.decoder, skills, SKILL_STEPS).cumsum(1) - executed.cumsum(1)
        found["self_consistency_error" + name] = (miss.square().mean() / executed.cumsum(1).square().mean()).sqrt().item()
    if EXPLORE:
        track = paths(actor, method.explorers(len(skills)), EPISODE, 1, None, False)
        found["explorer_coverage_cells"] = cells(track)
    return found


def cells(track):
    """How many cells of 1 m the paths (n, K, 2 or 1) in metres visit."""
    return len(np.unique(np.floor(track.reshape(-1, track.shape[2])), axis=0))


def draw_robots():
    """Fig 14: both robots, rendered by MuJoCo off-screen."""
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2))
    for ax, title, spec in zip(axes, ("Ant", "Half-Cheetah"), (ant_spec(), half_cheetah_spec())):
        model = spec.compile()
        data, camera = mujoco.MjData(model), mujoco.MjvCamera()
        data.qpos[:] = model.key_qpos[0] if model.nkey else model.qpos0
        mujoco.mj_forward(model, data)
        camera.lookat, camera.distance, camera.azimuth, camera.elevation = data.qpos[:3] if model.nkey else (0, 0, 0.5), 3, 120, -20
        try:
            renderer = mujoco.Renderer(model, 400, 500)
        except Exception:  # no GL library, no device: the kinds differ by platform
            print("no Fig 14: MuJoCo's renderer needs a GL library; install libegl1 (Debian, Ubuntu) or OSMesa with MUJOCO_GL=osmesa")
            return plt.close(figure)
        renderer.update_scene(data, camera)
        ax.imshow(renderer.render())
        ax.set(title=title, xticks=[], yticks=[])
        ax.grid(False)
    save_figure(figure, OUT, "fig14_robots")


# ---------------------------------------------------------------- training

def train(method, config):
    """Algorithm 1, policy training, of any method. Returns what the policy artifact holds."""
    rng = np.random.default_rng(SEED)
    torch.manual_seed(SEED)
    robots = make_robots(ROBOTS)
    s_dim, a_dim, z_dim, span = robots.observe().shape[1], robots.ctrl.shape[1], method.z_dim, method.span
    told = method.decoder if EGOCENTRIC and METHOD != "dads" else None
    actor = Actor(s_dim - EGOCENTRIC, robots.place if told else z_dim, a_dim, HIDDEN, told, EGOCENTRIC)
    n_in = actor.net[0].in_features
    critics, value, target = Critics(n_in + a_dim), value_network(n_in), value_network(n_in).requires_grad_(False)
    target.load_state_dict(value.state_dict())
    average = copy.deepcopy(actor).requires_grad_(False)  # of the late weights: single ones swing from report to report
    average.decoder = actor.decoder  # SeCTAR's learns
    networks = nn.ModuleList([actor, critics, value, method.model])
    optimizer = torch.optim.Adam(networks.parameters(), lr=LEARNING_RATE, fused=True)

    columns = (s_dim, a_dim, s_dim, robots.place, z_dim)  # s, a, s', displacement, z; one row a step, so that one gather makes a batch
    replay = torch.zeros(REPLAY // (ROBOTS * span) * ROBOTS * span, sum(columns))
    moved = replay[:, -robots.place - z_dim:-z_dim]
    z = method.sample(ROBOTS)
    age = rng.integers(0, EPISODE, ROBOTS)  # staggered, or all robots would start anew at once
    age -= age % span
    updates = env_steps = unstable = 0
    seconds, curve = 0.0, []
    robots.reset(np.arange(ROBOTS), rng)

    if resumable(OUT, "policy-checkpoint", EXPERIMENT, SEED, RESUME):
        state = load(OUT, "policy-checkpoint", EXPERIMENT, SEED)
        check_same(state, config, set(config) - {"RESUME", "OUT", "THREADS", "CHECKPOINT", "REPORTS", "UPDATES", "MINUTES"})
        networks.load_state_dict(state["networks"])
        target.load_state_dict(state["target"])
        average.load_state_dict(state["average"])
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
             average=average.state_dict(), optimizer=optimizer.state_dict(), replay=replay[:env_steps].clone(), z=z, age=torch.from_numpy(age),
             updates=updates, env_steps=env_steps, unstable=unstable, seconds=seconds, curve=curve, torch_rng=torch.get_rng_state(),
             robots={k: torch.from_numpy(robots.batch.bind(k).copy()) for k in ("qpos", "qvel", "ctrl", "time", "qacc_warmstart")},
             numpy_rng=rng.bit_generator.state)

    def report():
        own = {}
        if method.metric:
            with torch.no_grad(), torch.random.fork_rng():  # what is measured leaves the training as it is
                rows = trajectories(500, span, env_steps, replay, RECENT)
                own["metric"] = method.measure(moved[rows], replay[rows, -z_dim:])
        error, degrees, ratio = tracking(*grid_run(average, method.decoder)[:2])
        slow, mid, fast = by_speed(ratio)
        curve.append(dict(updates=updates, env_steps=env_steps, minutes=seconds / 60, tracking_error=float(error), reward=r.mean().item(),
                          direction_deg=float(degrees[2:].mean()), speed_slow=slow, speed_mid=mid, speed_fast=fast) | own)
        write_curve(curve)
        print(f"{updates:7d} updates {env_steps:8d} steps  tracking error {error:.3f}  direction {degrees[2:].mean():5.1f} deg  speed x "
              f"{slow:.2f} {mid:.2f} {fast:.2f}  reward {r.mean():6.3f}  floor {floor:.3f}  "
              + "".join(f"{method.metric} {v:.3f}  " for v in own.values()) +
              f"{updates / seconds:4.0f} updates/s  {seconds / 60 * (1 / progress - 1):4.0f} min left", flush=True)

    def share_done():
        return seconds / 60 / MINUTES if MINUTES else updates / UPDATES

    progress, last_save, interval = share_done(), time.time(), max(1, UPDATES // REPORTS)
    while progress < 1:
        clock, before = time.time(), updates
        # Collect: one step of every robot
        fresh = age % SKILL_STEPS == 0
        z[fresh] = method.sample(int(fresh.sum()))  # Alg. 1: sample z_single from the prior
        s = robots.observe()
        if env_steps < WARM_UP:
            a = torch.rand(ROBOTS, a_dim) * 2 - 1
        else:
            with torch.no_grad():
                a = actor.act(s, z, t=int(age[0]) % span)
        displacement, failed = robots.step(a.numpy())
        rows = torch.arange(env_steps, env_steps + ROBOTS) % len(replay)
        replay[rows] = torch.cat([s, a, robots.observe(), displacement, z], 1)
        replay[rows[failed]] = replay[rows[failed] - ROBOTS]  # an unstable step means nothing: the one before is kept once more
        env_steps += ROBOTS
        unstable += int(failed.sum())
        age += 1
        if len(over := np.flatnonzero((age >= EPISODE) | failed)):
            robots.reset(over, rng)
            age %= EPISODE
        if env_steps < WARM_UP:
            seconds += time.time() - clock
            continue
        if not updates:  # state statistics of the random steps, kept from here on
            first = replay[:env_steps, :s_dim]
            if EGOCENTRIC:
                with torch.no_grad():
                    first, *_ = egocentric(first, actor.wanted(replay[:env_steps, -z_dim:]))
            actor.s_mean.copy_(first.mean(0)), actor.s_std.copy_(first.std(0).clamp(min=1e-3))
            average.load_state_dict(actor.state_dict())

        # Improve: a few updates. What needs no gradient is computed for all of them at once
        floor = FLOOR_START * (FLOOR_END / FLOOR_START) ** min(1, max(0, (progress - 0.15) / 0.45))
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * min(1, (1 - progress) / max(1 - DECAY_FROM, 1e-9))
        s, a, _, displacement, skill = replay[trajectories(MODEL_BATCH, span, env_steps, replay, RECENT)].split(columns, 2)
        model_loss = method.loss(s, a, displacement, skill, actor)
        share = min(span, 2 * UPDATES_PER_STEP)  # steps of a trajectory in the batch, two in each update: decoded and relabelled once
        rows = trajectories(UPDATES_PER_STEP * BATCH // share, span, env_steps, replay, len(replay))
        t, skill = torch.randint(span, (share, len(rows))), replay[rows[:, 0], -z_dim:]
        fresh = torch.rand(len(skill)) < RELABELLED
        skill[fresh] = method.sample(int(fresh.sum()))  # a copy: replay keeps its own
        s, a, s2, _, _ = replay[rows[torch.arange(len(rows)), t].flatten()].split(columns, 1)
        with torch.no_grad():
            r, step, after = method.reward(moved[rows], t, skill, floor)
            skill = skill.repeat(share, 1)
            x, turns = actor.inputs(s, skill, step)
            x2, _ = actor.inputs(s2, skill, after)
            a = actor.seen(a, turns)
        for i, small in enumerate(zip(*(v.split(BATCH) for v in (x, a, x2, r)))):
            losses = sac_losses(actor, critics, value, target, *small)
            optimizer.zero_grad()
            (sum(losses) + (model_loss if i == 0 else 0)).backward()  # SAC's three touch disjoint parameters
            optimizer.step()
            torch._foreach_lerp_(list(target.parameters()), list(value.parameters()), SMOOTHING)
            torch._foreach_lerp_(list(average.net.parameters()), list(actor.net.parameters()), AVERAGED)
            updates += 1
        seconds += time.time() - clock
        progress = share_done()

        for name, metric in zip(("actor loss", "critic loss", "value loss", "model loss", "reward"), (*losses, model_loss, r.mean())):
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
    parts = dict(actor=average, decoder=method.decoder) | dict(method.model.items())
    return dict({name: part.state_dict() for name, part in parts.items()}, curve=curve, updates=updates, env_steps=env_steps, seconds=seconds)


def take(decoder):
    """What the policy artifact holds, without training: TAKEN's policy with another decoder in it. It knows wanted steps, not skills."""
    content = load(OUT, "policy", TAKEN, SEED)
    if "decoder.axes" not in content["actor"]:
        stop(f"the policy of {TAKEN} is not egocentric and walks its own skills only; train instead, with --taken ''")
    state = {name: value for name, value in content["actor"].items() if not name.startswith("decoder.")}
    state |= {f"decoder.{name}": value for name, value in decoder.state_dict().items()}
    return content | dict(actor=state, decoder=decoder.state_dict(), curve=[])


if __name__ == "__main__":
    config = parse_flags(globals())
    torch.set_num_threads(THREADS)
    if METHOD not in METHODS:
        stop(f"unknown method {METHOD!r}; allowed: {' '.join(METHODS)}")
    if METHOD == "wedis":
        source = load(OUT, "wetvae", DECODER, DECODER_SEED)
        decoder, names, ranges = load_decoder(source), source["names"], source["ranges"]
        weight, miss = calibrate_relation(decoder)
    else:
        weight, names, ranges = None, list(FACTORS), list(FACTORS.values())
    torch.manual_seed(SEED)
    method = Wedis(decoder) if METHOD == "wedis" else METHODS[METHOD]()
    if TRAIN:
        least = max(BATCH, ROBOTS * method.span)
        if not least <= WARM_UP <= REPLAY or not UPDATES or EPISODE % method.span or method.span > 1 and REPLAY < 2 * least:
            more = f"; for {METHOD} --warm_up must be at least {least}, --replay {2 * least}, and --skill_steps divide --episode"
            stop(f"--updates must be at least 1 and --warm_up {WARM_UP} must lie between --batch {BATCH} and --replay {REPLAY}"
                 + more * (method.span > 1))
        trained = take(decoder) if TAKEN else train(method, config)
        if CALIBRATED and METHOD == "wedis" and EGOCENTRIC and not TAKEN:
            torch.manual_seed(SEED)  # the same numbers however long was trained
            trained["actor"]["told"] = calibrate_steps(load_actor(trained))
        kept = {name: trained[name] for name in ("actor", "decoder", "encoder", "curve", "updates", "env_steps", "seconds") if name in trained}
        save(OUT, "policy", EXPERIMENT, SEED, config, relation_weight=weight, **kept)
    policy = load(OUT, "policy", EXPERIMENT, SEED)
    check_same(policy, config, ("METHOD",))
    actor, decoder = load_actor(policy), load_decoder(policy)

    ant, values = ROBOT == "ant", np.linspace(-Z_RANGE, Z_RANGE, TRAVERSAL)
    if METHOD == "wedis":
        print(f"\nrelation function, calibrated: z_{names[1 if ant else 0]} {weight:+.3f} {'' if ant else 'sign(z_speed) '}z_{names[-1]}   "
              f"(the paper, by hand: {0.2 if ant else 0.1} in size)")
        print(f"  free run of the decoder missed by {miss(weight):.1%} RMS; with the paper's size by {miss(0.2 if ant else 0.1):.1%}, "
              f"without by {miss(0.0):.1%}")
        z = traversal(len(names) - 1, values)
        predicted = 40 * STEP_SCALE * predict(decoder, z, 5).numpy().sum(1)
        for w in (weight, 0.0):
            away, size = (np.linalg.norm(v, axis=1).mean() for v in (paths(actor, z, 5, 40, w)[:, -1] - predicted, predicted))
            print(f"  on the robot (T = 5, H_z = 40): weight {w:.3f} ends {away:.2f} m from the decoder's path of {size:.1f} m")

    told, actor.told = actor.told, torch.zeros(0, 0, 2)
    executed, commanded, flipped = grid_run(actor, decoder)
    error_as_trained, *_, ratio = tracking(executed, commanded)
    actor.told = told
    print()
    if told.numel():
        print(f"as trained: tracking error {error_as_trained:.3f}, achieved/commanded {' '.join(f'{v:.2f}' for v in ratio)}; "
              "with steps calibrated:")
        executed, commanded, flipped = grid_run(actor, decoder)
    error, degrees, ratio = tracking(executed, commanded)
    torch.manual_seed(SEED)
    error_sampled, *_ = tracking(*grid_run(actor, decoder, deterministic=False)[:2])
    accelerating = "acceleration" in names
    profiles = []
    for i in range(AXES):  # the mean over noisy starts
        track = paths(actor, traversal(i, values).repeat(STARTS, 1), 5, PROFILE, weight, noise=np.random.default_rng(SEED + 2), run_in=PROFILE)
        profiles.append(np.diff(track[:, ::PROFILE], axis=1).reshape(STARTS, TRAVERSAL, 5, -1).mean(0) / (PROFILE * STEP_SCALE))
    C, purity = cross_talk([factors_of(profile, accelerating) for profile in profiles], names, ranges)
    if METHOD == "wedis":
        skills = nn.functional.pad(torch.randn(COVERAGE, len(names) - 1), (0, 1))
        purity = dict(zip(names, purity))
    else:
        skills = torch.rand(COVERAGE, AXES) * 2 - 1 if METHOD == "dads" else torch.randn(COVERAGE, AXES)
        purity = {names[f]: p for f, (_, p) in match(C).items()}
    coverage = cells(paths(actor, skills, LENGTH, HOLD if METHOD == "sectar" else EPISODE, None if weight is None else 0.0))
    print(f"tracking error {error:.3f} (mean actions), {error_sampled:.3f} (sampled actions); flips {flipped.sum()} of {len(flipped)}")
    print("from slow to fast")
    print("direction error deg " + " ".join(f"{d:6.1f}" for d in degrees))
    print("achieved/commanded  " + " ".join(f"{v:6.2f}" for v in ratio))
    if accelerating:
        promised = predict(decoder, traversal(1, values), 5).numpy()
        print(f"accelerating skill: speed profile {np.sqrt(((profiles[1] - promised) ** 2).mean() / (promised ** 2).mean()):.3f} from the prediction")
    print("executed cross-talk: " + "; ".join(f"z_{names[i] if METHOD == 'wedis' else i + 1} " + " ".join(f"{c:.2f}" for c in row)
                                              for i, row in enumerate(C)) + "; purity " + " ".join(f"{n} {p:.2f}" for n, p in purity.items()))
    print(f"coverage of {COVERAGE} random skills: {coverage} cells of 1 m")
    if METHOD != "wedis":
        extra = measure_baseline(actor, policy, method, skills)
        print(f"{method.metric}: " + ", ".join(f"{what} {value:.3f}" for what, value in extra.items()))
        rows = [dict(method=EXPERIMENT.removeprefix("ant_"), seed=SEED, what=what, value=value) for what, value in extra.items()]
        update_csv(Path(OUT) / "results" / "baselines.csv", rows, ("method", "seed", "what"))
    slow, mid, fast = by_speed(ratio)
    update_csv(Path(OUT) / "results" / "policies.csv", [dict(
        experiment=EXPERIMENT, method=METHOD, robot=ROBOT, seed=SEED, updates=policy["updates"], env_steps=policy["env_steps"],
        train_minutes=policy["seconds"] / 60, tracking_error=error, tracking_error_sampled=error_sampled,
        direction_error_deg=degrees[2:].mean(), speed_ratio_slow=slow, speed_ratio_mid=mid, speed_ratio_fast=fast, flips=int(flipped.sum()),
        **{f"purity_{n}": purity.get(n, "") for n in ("speed", "direction", "curvature", "acceleration")},
        coverage_cells=coverage, tracking_error_as_trained=error_as_trained)], ("experiment", "method", "seed"))
    five, circle = list(common.LATENT_COLOURS), [round(float(v), 3) for v in grid()[:DIRECTIONS, 1]] if METHOD == "wedis" and ant else []
    latents = [(f"$z_{i + 1}$", i, five, LENGTH, HOLD) for i in range(AXES)]
    draw_skills(actor, decoder, weight, *{
        "ant_semi": ("fig05_skills_wedis", [("$z_{speed}$", 0, five, 1, 100), ("$z_{dir}$", 1, five, 1, 100), ("$z_{cur}$", 2, five, 5, 40)]),
        "ant_full": ("fig15_full_circle", [("$z_{speed}$", 0, five, 1, 100), ("$z_{dir}$", 1, circle, 1, 100)]),
        "ant_dads": ("fig05_skills_dads", latents), "ant_sectar": ("fig05_skills_sectar", latents),
        "ant_sectar_no_explorer": ("skills_sectar_no_explorer", latents),
        "half_cheetah": ("fig16_half_cheetah", [("$z_{speed}$", 0, np.linspace(-1, 1, 9), 6, 20), ("$z_{acc}$", 1, np.linspace(-1, 1, 9), 6, 20)]),
    }[EXPERIMENT])
    if policy["curve"]:
        write_curve(policy["curve"])
        draw_learning_curve()
    draw_robots()

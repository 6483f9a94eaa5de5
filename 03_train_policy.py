"""Stage 3: decoder -> skill policy pi(a | s, c), trained by SAC on single steps (Sec. 4.2, Alg. 1, A.1.3).

In: wetvae_<DECODER>_seed<n>.pt of stage 2. The command c of a skill z_single is the decoder's first
displacement. The reward is the decoder's log-likelihood of the step that the robot makes (Eq. 6).
Out: runs/policy_<experiment>_seed<n>.pt, Fig 5 (15, 16) and a row of runs/results/policies.csv.
Takes 11 to 15 minutes on two cores (149 to 112 updates/s). Expect, mean of 3 seeds: tracking error 0.10
in open loop; in closed loop 0.03, a median following error of 0.08 m, and 1.3 % of the robots turn over.
"""
import copy
import math
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import common
from common import (MULTI, SINGLE, Actor, Count, Decoder, Positive, Share, Threads, commands_of, execute,
                    factors_of, layers, plt, stop)
import numpy as np
import torch
from torch import nn

EXPERIMENT: str = "ant_semi"  # row of EXPERIMENTS below
SEED: int = 0                 # random seed of the whole chain: data, decoder, policy
OUT: str = "runs"             # folder that everything is written to
TRAIN: bool = True            # false: only measure and draw what is already trained
RESUME: bool = False          # true: continue from the last checkpoint
THREADS: Threads = 2          # 1: updates wait for the robots' step; the result is the same

DECODER: str = "main"         # model of 02 whose decoder is the reward
ROBOT: str = "ant"            # ant or half_cheetah
STEP_SCALE: Positive = 0.1    # metres a step per trajectory unit, App. A.1.3: 1/10, Half-Cheetah 1/5
BASE_FRAME: bool = True       # networks read state and command in the base frame (the paper: false)

UPDATES: Count = 100_000      # updates of the critics (the paper: 1,920,000)
ROBOTS: Count = 256           # robots that step together
EPISODE: Count = 200          # steps until a robot starts anew; for the critics an episode has no end
SKILL_STEPS: Count = 25       # steps until a robot is given a new skill
WARM_UP: Count = 10_000       # steps, of all robots together, with random actions; they normalise the state
REPLAY: Count = 1_000_000     # steps, of all robots together, in the replay buffer R
UPDATES_PER_STEP: Count = 8   # updates each time that all robots make a step
BATCH: Count = 256            # App. A.1.3
RELABELLED: Share = 0.5       # share of a batch that is relabelled with a fresh skill (the paper: 0)

HIDDEN: Count = 256           # width of both hidden layers (the paper: 512; Half-Cheetah 256)
LEARNING_RATE: Positive = 1e-3  # of Adam (the paper: 0.0003, fixed)
DECAY_FROM: Share = 0.5       # share of the updates after which the rate falls, linearly to 0 (the paper: 1)
ACTOR_EVERY: Count = 2        # updates of the critics for each one of actor, value, target (the paper: 1)
AVERAGED: Share = 0.002       # rate of the actor's running average, the policy; 0: none (the paper: 0)
DISCOUNT: Share = 0.99        # gamma of Eq. 1
SMOOTHING: Share = 0.01       # of the target value network, App. A.1.3
REWARD_SCALE: float = 0.1     # of Eq. 6 (the paper: 1)
TEMPERATURE: float = 0.003    # alpha, weight of the entropy (the paper: 0.01, that is 0.001 at our scale)
FLOOR_START: float = 0.04     # metres, least deviation in the reward; without one robots hardly move
FLOOR_END: float = 0.01       # what it shrinks to until DECAY_FROM, geometrically (the paper: 0)

# Baselines only
METHOD: str = "wedis"         # wedis, or a baseline: dads or sectar
Z_DIM: Count = 2              # entries of z: DADS 2, SeCTAR 8
RECENT: Count = 40_000        # latest steps that a baseline's model learns from
MODEL_BATCH: Count = 256      # steps (DADS), trajectories (SeCTAR) in a batch
MODEL_UPDATES: Count = 4      # DADS: updates of the skill dynamics in each step of all robots
PRIOR_SAMPLES: Count = 100    # L of DADS's reward

# Measuring only: never an obstacle to --resume
REPORTS: Count = 20           # printed lines, points of the learning curve, and checkpoints
Z_RANGE: Positive = 1.5       # skills are measured for z from -Z_RANGE to Z_RANGE
SINGLE_RUN: tuple[Count, Count] = (1, 100)  # T, H_z of the tracking error and Fig 5 for z_single, Sec. 6.1.2
MULTI_RUN: tuple[Count, Count] = (5, 40)  # T, H_z of the following error, purity and Fig 5 for z_multi
TRAVERSAL: Count = 13         # skills on each axis at which purity is measured
NOISY: Count = 16             # noisy starts that are averaged for purity
STARTS: Count = 400           # noisy starts of the following error
FIGURE: str = ""              # name of the figure of skills ("": skills_<experiment>)

EXPERIMENTS = {  # a row names the constants in which an experiment differs
    "ant_semi": dict(FIGURE="fig05_skills_wedis"),
    "ant_full": dict(DECODER="full", FIGURE="fig15_full_circle"),
    "half_cheetah": dict(DECODER="speed_acc", ROBOT="half_cheetah", STEP_SCALE=0.2, BASE_FRAME=False,
                         ROBOTS=64, SKILL_STEPS=100, DISCOUNT=0.97, Z_RANGE=1.0, MULTI_RUN=(6, 20),
                         FIGURE="fig16_half_cheetah"),  # the paper: discount 0.99
    "ant_world_frame": dict(BASE_FRAME=False),  # the paper's frame
    "ant_dads": dict(METHOD="dads", Z_RANGE=1.0, SKILL_STEPS=200, REWARD_SCALE=1.0, DISCOUNT=0.995,
                     MULTI_RUN=(1, 200), FIGURE="fig05_skills_dads"),
    "ant_sectar": dict(METHOD="sectar", UPDATES=30_000, Z_DIM=8, SKILL_STEPS=50, RECENT=512_000,
                       MODEL_BATCH=128, REWARD_SCALE=1.0, DISCOUNT=0.98, SINGLE_RUN=(50, 1),
                       MULTI_RUN=(50, 1), FIGURE="fig05_skills_sectar"),  # more updates do not make it move
}
MAY_DIFFER = (  # between a policy, or a checkpoint, and the run that uses it
    "OUT TRAIN RESUME THREADS REPORTS UPDATES Z_RANGE SINGLE_RUN MULTI_RUN TRAVERSAL NOISY STARTS FIGURE "
    "FEEDBACK CORRECTION CLASSES").split()


# -------- Eq. 5 in the form of Eq. 6, and Algorithm 1, policy training

def reward(c, log_var, displacement, floor):
    """REWARD_SCALE * log p_theta(s_t+1 | s_t, z), Eq. 6, (B,), without the normaliser: no action changes it.
    c, the command, and log_var (B, 2 or 1): the decoder's mean and log-variance, trajectory units;
    displacement (B, 2 or 1), s_t+1 - s_t of Eq. 6, whose s is the place alone, and floor: metres."""
    variance = STEP_SCALE ** 2 * log_var.exp()  # square metres (the paper: 1/20 in place of STEP_SCALE ** 2)
    variance = variance.clamp(min=floor ** 2)  # without a floor robots hardly move
    return REWARD_SCALE * -0.5 * ((displacement - STEP_SCALE * c) ** 2 / variance).sum(1)


def train_wedis(decoder, names):
    """Alg. 1, the second loop: a policy that follows single steps of the decoder, whose weights are fixed.
    Returns the policy. Shapes beside the lines: the Ant, n = ROBOTS, B = UPDATES_PER_STEP * BATCH = 2048."""
    m1 = sum(name in SINGLE for name in names)  # M_1; the axes of z_single come first
    m2 = len(names) - m1  # M_2
    robots, rng, submit = start_robots()
    s_dim, a_dim = robots.observe().shape[1], robots.ctrl.shape[1]
    sac = Sac(s_dim, decoder.x_dim, a_dim)  # Alg. 1: initialize psi, psi bar, psi hat
    replay = Replay(s=s_dim, a=a_dim, s2=s_dim, displacement=decoder.x_dim, z_single=m1)
    policy = make_policy(sac, decoder, names, STEP_SCALE)  # it acts with sac.average
    # With --resume true, Log puts back the robots, replay and sac of the last checkpoint
    log = Log(policy, robots, rng, replay, sac)
    z_single = replay.latest(ROBOTS).z_single  # zeros at first, until a robot's skill is over

    while sac.updates < UPDATES:
        # Alg. 1: sample z_single from the prior, for the robots whose skill is over; set z = (z_single, 0)
        over = robots.age() % SKILL_STEPS == 0                                       # (n, 1)
        z_single = torch.where(over, torch.randn(ROBOTS, m1), z_single)              # (n, 2)
        z = torch.cat([z_single, torch.zeros(ROBOTS, m2)], 1)                        # (n, 3)
        c = decoder(z, 1)[0][:, 0]  # the command: the decoder's first displacement; (n, 2)

        # Alg. 1: execute actions a ~ pi(a | s, z_single), here pi(a | s, c): unlike z, c can be rotated
        s = robots.observe()                                                         # (n, 27)
        a = sac.actor.act(s, c)                                                      # (n, 8)
        if replay.added < WARM_UP:
            a = torch.rand(a.shape) * 2 - 1
        physics = submit(a)  # a second core steps the robots while the networks learn

        if replay.added >= WARM_UP:
            if sac.updates == 0:
                sac.normalise(replay.read(slice(0, replay.added)).s)
            # Alg. 1: sample a batch of transitions. Relabelling: any step can be judged by any skill
            batch = replay.sample(UPDATES_PER_STEP * BATCH)                          # (B, ..) each
            fresh = torch.rand(len(batch.s), 1) < RELABELLED                         # (B, 1)
            batch.z_single = torch.where(fresh, torch.randn(len(fresh), m1), batch.z_single)
            z = torch.cat([batch.z_single, torch.zeros(len(fresh), m2)], 1)          # (B, 3)

            # Alg. 1: compute the reward r = log p_theta(s_t+1 | s_t, z), Eq. 6
            c, log_var = (out[:, 0] for out in decoder(z, 1))                        # (B, 2) each
            shrunk = min(1, sac.updates / max(DECAY_FROM * UPDATES, 1))              # from 0 to 1
            floor = FLOOR_START ** (1 - shrunk) * FLOOR_END ** shrunk                # metres
            r = reward(c, log_var, batch.displacement, floor)                        # (B,)

            # Alg. 1: optimize psi, psi bar, psi hat with the SAC, BATCH steps at a time
            log.numbers = sac.learn(batch, c, r) | dict(reward=r.mean())

        # Alg. 1: collect the samples in the replay buffer R (after the updates, which ran meanwhile)
        displacement, unstable = physics.result()                                    # (n, 2) metres, (n,)
        replay.add(unstable, s=s, a=a, s2=robots.observe(), displacement=displacement, z_single=z_single)
        robots.reset(np.flatnonzero((robots.age()[:, 0].numpy() >= EPISODE) | unstable), rng)
        log.step()
    return policy


# -------- SAC (Haarnoja et al. 2017), App. A.1.3

class Sac(nn.Module):
    """Actor psi, twin critics (psi bar; Alg. 1 names one), value (psi hat), its target network; the
    temperature is fixed. average: the policy, a running average of the actor's weights."""

    def __init__(self, s_dim, c_dim, a_dim):
        super().__init__()
        self.actor = Actor(s_dim, c_dim, a_dim, HIDDEN, BASE_FRAME)
        n_in = self.actor.net[0].in_features
        self.critics = nn.ModuleList(layers(n_in + a_dim, HIDDEN, 1) for _ in range(2))
        self.value = layers(n_in, HIDDEN, 1)
        self.target = copy.deepcopy(self.value).requires_grad_(False)
        self.average = copy.deepcopy(self.actor).requires_grad_(False)
        self.critic_adam = torch.optim.Adam(self.critics.parameters(), fused=True)
        self.actor_adam = torch.optim.Adam([*self.actor.parameters(), *self.value.parameters()], fused=True)
        self.updates, self.losses = 0, {}

    def normalise(self, s):
        """Fix the mean and deviation of the state, once, from states s (N, s_dim) under random actions."""
        x = self.actor.inputs(s, torch.zeros(len(s), 2))[:, :len(self.actor.s_mean)]  # clipped to +-10
        self.actor.s_mean.copy_(x.mean(0))
        self.actor.s_std.copy_(x.std(0, correction=0).clamp(min=1e-3))
        self.average.load_state_dict(self.actor.state_dict())

    def learn(self, batch, c, r):
        """Updates with the steps of batch, BATCH at a time. c (B, c_dim): their commands, also after the
        step, as if no skill ended; r (B,): rewards. Returns the last losses."""
        rate = LEARNING_RATE * min(1, (1 - self.updates / UPDATES) / max(1 - DECAY_FROM, 1e-9))
        for group in self.critic_adam.param_groups + self.actor_adam.param_groups:
            group["lr"] = rate
        x, x2 = self.actor.inputs(batch.s, c), self.actor.inputs(batch.s2, c)
        for part in zip(x.split(BATCH), batch.a.split(BATCH), x2.split(BATCH), r.split(BATCH)):
            self.update(*part)
        return self.losses

    def update(self, x, a, x2, r):
        """One update; no step is terminal. x, x2 (BATCH, 26 + 2): Actor.inputs before and after the step; a
        (BATCH, 8); r (BATCH,). One backward serves actor and value, and leaves out the critics."""
        q_target = r + DISCOUNT * self.target(x2).squeeze(1)
        q1, q2 = (critic(torch.cat([x, a], 1)).squeeze(1) for critic in self.critics)
        q_loss = 0.5 * ((q1 - q_target) ** 2 + (q2 - q_target) ** 2).mean()
        self.critic_adam.zero_grad()
        q_loss.backward()
        self.critic_adam.step()
        self.updates += 1
        self.losses |= dict(q=q1.detach().mean(), q_loss=q_loss.detach())
        if self.updates % ACTOR_EVERY:
            return
        a_new, log_prob = self.actor(x)
        q1, q2 = (critic(torch.cat([x, a_new], 1)).squeeze(1) for critic in self.critics)
        q_new = torch.minimum(q1, q2)
        actor_loss = (TEMPERATURE * log_prob - q_new).mean()  # Eq. 6, with the entropy of actions
        v_loss = 0.5 * ((self.value(x).squeeze(1) - (q_new - TEMPERATURE * log_prob).detach()) ** 2).mean()
        self.actor_adam.zero_grad()
        (actor_loss + v_loss).backward(inputs=[*self.actor.parameters(), *self.value.parameters()])
        self.actor_adam.step()
        with torch.no_grad():  # target += SMOOTHING * (value - target); average alike, or (0) a copy
            torch._foreach_lerp_([*self.target.parameters()], [*self.value.parameters()], SMOOTHING)
            torch._foreach_lerp_([*self.average.parameters()], [*self.actor.parameters()], AVERAGED or 1.0)
        self.losses |= dict(actor_loss=actor_loss.detach())


def main():
    config, _ = common.parse_flags(globals())
    torch.set_num_threads(1)  # for the networks; a second one steps the robots
    source = common.load(OUT, "wetvae", DECODER, SEED)
    check(source)
    if TRAIN:
        torch.manual_seed(SEED)
        train = dict(wedis=train_wedis, dads=train_dads, sectar=train_sectar)[METHOD]
        policy = train(source["decoder"], source["names"])
        policy.relation = source["relation"]  # Alg. 1 finds them here, by hand; 02 found them in the decoder
        common.save(OUT, "policy", EXPERIMENT, SEED, config, **vars(policy))  # before it is measured
    policy = SimpleNamespace(**common.load(OUT, "policy", EXPERIMENT, SEED, **made_with()))
    same_decoder(policy, source["decoder"])
    measure(policy, source["ranges"], config)
    follow_one_skill(policy, source)
    draw_skills(policy)


# ======== not needed to understand the method
# -------- what a training needs besides

def check(source):
    """Exits with 2 if constants do not fit one another, or the decoder of `source`."""
    decoder, names = source["decoder"], source["names"]
    if METHOD not in ("wedis", "dads", "sectar") or ROBOT not in ("ant", "half_cheetah"):
        stop("--method is wedis, dads or sectar; --robot is ant or half_cheetah")
    if ROBOT != "ant" and (BASE_FRAME or METHOD != "wedis"):
        stop(f"the {ROBOT} runs on a rail: --base_frame false; DADS and SeCTAR need --robot ant")
    usable = names[0] == "speed" and all(name in SINGLE or MULTI.get(name) in names for name in names)
    if not usable or decoder.x_dim != 1 + (ROBOT == "ant"):
        stop(f"the decoder {DECODER} has axes {' '.join(names)} and predicts {decoder.x_dim} coordinates: "
             f"the {ROBOT} needs another --decoder")
    if DISCOUNT == 1:
        stop("--discount must be below 1: no step is terminal, so values would have no bound")
    if METHOD == "dads" and (Z_DIM != 2 or SINGLE_RUN[0] * MULTI_RUN[0] > 1):
        stop("DADS needs --z_dim 2, and T, the first of --single_run and of --multi_run, must be 1")
    common.need_memory(300 * max(REPLAY, 2 * ROBOTS * SKILL_STEPS) + 50_000 * ROBOTS, "--replay or --robots")
    common.need_memory(400 * HIDDEN ** 2 + 1000 * UPDATES_PER_STEP * BATCH, "--hidden or --batch")
    common.need_memory(100_000 * (STARTS + NOISY * TRAVERSAL), "--starts, --noisy or --traversal")


def made_with():
    """What must be the same in a policy, or a checkpoint, and in the run that uses it."""
    made = common.made_by({name: globals()[name] for name in common.types_of(globals())})
    return {name: value for name, value in made.items() if name not in MAY_DIFFER
            and (name == f"{ROBOT}.xml" or not name.endswith(".xml"))}


def same_decoder(policy, decoder):
    """Exits with 2 if a policy of WEDIS has learnt from another decoder."""
    if METHOD == "wedis" and not torch.equal(policy.decoder.cell.weight_hh, decoder.cell.weight_hh):
        stop(f"the policy has learnt from another decoder {DECODER}: train anew without --resume, or choose "
             "another --out")


def start_robots():
    """ROBOTS robots near the origin, each at a random moment of its episode, so that skills change at all
    times; the generator of their starts; and what submits their next step to the second core."""
    robots, rng = common.Robots(common.robot_spec(ROBOT), ROBOTS), np.random.default_rng(SEED)
    robots.reset(np.arange(ROBOTS), rng)
    robots.time[:] = rng.integers(0, EPISODE, ROBOTS) * robots.step_seconds
    worker = ThreadPoolExecutor(1)

    def submit(action):
        physics = worker.submit(robots.step, action.numpy())
        if THREADS == 1:
            physics.result()
        return physics

    return robots, rng, submit


def make_policy(sac, decoder, names, scale):
    """What 04 needs of a policy, and what the reports measure."""
    return SimpleNamespace(actor=sac.average, decoder=decoder, names=names, scale=scale, method=METHOD,
                           robot=ROBOT, relation={}, updates=0, env_steps=0, seconds=0.0, curve=[])


class Replay:
    """The replay buffer R of Alg. 1: a ring of the latest steps of all robots. Fields lie side by side in one
    table, since a random row is then read at once."""

    def __init__(self, **widths):
        self.widths, self.added = widths, 0
        block = ROBOTS * SKILL_STEPS  # in whole blocks, rows ROBOTS apart are of one robot
        self.table = torch.zeros(max(2, REPLAY // block) * block, sum(widths.values()))

    def add(self, unstable, **fields):
        """One step of all robots: fields (n, width) each. unstable (n,): whose step means nothing."""
        rows = (self.added + torch.arange(ROBOTS)) % len(self.table)
        self.table[rows] = torch.cat([fields[name] for name in self.widths], 1)
        self.table[rows[unstable]] = self.table[rows[unstable] - ROBOTS]  # repeat the robot's step before
        self.added += ROBOTS

    def read(self, rows):
        """The fields of rows (..): a namespace of tensors (.., width)."""
        parts = self.table[rows].split(list(self.widths.values()), -1)
        return SimpleNamespace(**dict(zip(self.widths, parts)))

    def latest(self, n):
        """The last n steps, of all robots; at the start zeros."""
        n = min(n, max(self.added, ROBOTS), len(self.table))
        return self.read((self.added - n + torch.arange(n)) % len(self.table))

    def sample(self, n):
        """n random steps."""
        back = torch.randint(min(self.added, len(self.table)), (n,))
        return self.read((self.added - 1 - back) % len(self.table))


class Log:
    """The clock of a training, its printed lines, learning curve and checkpoints. parts: whatever else has a
    state_dict. With --resume true it puts everything back where the last checkpoint was."""

    def __init__(self, policy, robots, rng, replay, sac, *parts):
        self.policy, self.robots, self.rng, self.replay, self.sac = policy, robots, rng, replay, sac
        self.parts, self.numbers = [sac, sac.critic_adam, sac.actor_adam, *parts], {}
        path = Path(OUT) / common.artifact_name("policy-checkpoint", EXPERIMENT, SEED)
        if RESUME and not path.exists():
            print("there is no checkpoint yet")
        elif RESUME:
            saved = common.load(OUT, "policy-checkpoint", EXPERIMENT, SEED, **made_with())
            same_decoder(SimpleNamespace(**saved), policy.decoder)
            for part, state in zip(self.parts, saved["parts"]):
                part.load_state_dict(state)
            for name in ("curve", "seconds", "scale", "updates", "env_steps"):
                setattr(policy, name, saved[name])
            sac.updates, replay.added = policy.updates, policy.env_steps
            replay.table[:len(saved["table"])] = saved["table"]
            robots.batch.state[:] = saved["robots"].numpy()
            torch.set_rng_state(saved["torch_rng"])
            rng.bit_generator.state = saved["rng"]
        self.clock = time.time()

    def step(self):
        """Once a step: a line, a point of the learning curve and a checkpoint if they are due."""
        policy = self.policy
        policy.updates, policy.env_steps = self.sac.updates, self.replay.added
        if not all(math.isfinite(value) for value in self.numbers.values()):
            stop(f"a loss is not finite after {policy.updates} updates; lower --learning_rate (or "
                 "--reward_scale) and train anew: with --resume true the same would happen again", code=1)
        reported = policy.curve[-1]["updates"] if policy.curve else 0
        if policy.updates < min(UPDATES, reported + UPDATES / REPORTS):
            return
        policy.seconds += time.time() - self.clock
        row = dict(updates=policy.updates, env_steps=policy.env_steps, minutes=policy.seconds / 60,
                   tracking_error=tracking(policy, False))
        if METHOD == "wedis":
            row["tracking_error_closed"] = tracking(policy, True)
        policy.curve.append(row | {name: float(value) for name, value in self.numbers.items()})
        left = policy.seconds / 60 * (UPDATES / policy.updates - 1)
        words = [f"{name} {round(value, 3)}" for name, value in policy.curve[-1].items()]
        words += [f"{policy.updates / policy.seconds:.0f} updates/s", f"{left:.1f} min left"]
        print(*words, sep="  ", flush=True)
        common.save(OUT, "policy-checkpoint", EXPERIMENT, SEED, made_with(), **vars(policy),
                    robots=torch.from_numpy(self.robots.batch.state.copy()), torch_rng=torch.get_rng_state(),
                    table=self.replay.table[:self.replay.added].clone(), rng=self.rng.bit_generator.state,
                    parts=[part.state_dict() for part in self.parts])
        self.clock = time.time()


# -------- baselines: not needed for WEDIS. Loops as above, with models that are learnt at the same time

def train_dads(_decoder, _names):
    """Sharma et al. 2019: skills z ~ U(-1, 1)^2. The reward is the mutual information of step and z under the
    skill dynamics q(displacement | z) (theirs: q(s' | s, z), a mixture of four Gaussians), learnt at the
    same time: one Gaussian of deviation 1 in units of the root mean square of recent displacements. As in
    their code the deviation is not learnt: that would reward standing still."""
    robots, rng, submit = start_robots()
    s_dim, a_dim = robots.observe().shape[1], robots.ctrl.shape[1]
    sac, replay = Sac(s_dim, Z_DIM, a_dim), Replay(s=s_dim, a=a_dim, s2=s_dim, displacement=2, z=Z_DIM)
    dynamics = Decoder(Z_DIM, 2, 64)
    adam = torch.optim.Adam(dynamics.parameters(), lr=LEARNING_RATE, fused=True)
    log = Log(make_policy(sac, dynamics, [], STEP_SCALE), robots, rng, replay, sac, dynamics, adam)
    z = replay.latest(ROBOTS).z

    def log_q(displacement, z):  # up to a constant; (B, 2), own z (B, 2) -> (B,); (B, 1, 2), (L, 2) -> (B, L)
        return -0.5 * ((displacement / log.policy.scale - dynamics(z, 1)[0][:, 0]) ** 2).sum(-1)

    while sac.updates < UPDATES:
        z = torch.where(robots.age() % SKILL_STEPS == 0, torch.rand(ROBOTS, Z_DIM) * 2 - 1, z)
        s = robots.observe()
        a = sac.actor.act(s, z) if replay.added >= WARM_UP else torch.rand(ROBOTS, a_dim) * 2 - 1
        physics = submit(a)
        if replay.added >= WARM_UP:
            if sac.updates == 0:
                sac.normalise(replay.read(slice(0, replay.added)).s)
            recent = replay.latest(RECENT)
            log.policy.scale = recent.displacement.square().mean().sqrt().clamp(min=1e-4).item()
            for _ in range(MODEL_UPDATES):
                rows = -1 - torch.randint(len(recent.z), (MODEL_BATCH,))  # each step with its own skill
                model_loss = -log_q(recent.displacement[rows], recent.z[rows]).mean()
                adam.zero_grad()
                model_loss.backward()
                adam.step()
            batch = replay.sample(UPDATES_PER_STEP * BATCH)
            fresh = torch.rand(len(batch.z), 1) < RELABELLED
            batch.z = torch.where(fresh, torch.rand(batch.z.shape) * 2 - 1, batch.z)
            with torch.no_grad():  # log(L + 1) - log(1 + sum_i q(.|z_i) / q(.|z)); all steps share the z_i
                own = log_q(batch.displacement, batch.z)
                others = log_q(batch.displacement[:, None], torch.rand(PRIOR_SAMPLES, Z_DIM) * 2 - 1)
                ratios = (others - own[:, None]).clamp(-50, 50).exp().sum(1)
                r = REWARD_SCALE * (math.log(PRIOR_SAMPLES + 1) - (1 + ratios).log())
            log.numbers = sac.learn(batch, batch.z, r) | dict(reward=r.mean(), model_loss=model_loss.detach())
        displacement, unstable = physics.result()
        replay.add(unstable, s=s, a=a, s2=robots.observe(), displacement=displacement, z=z)
        robots.reset(np.flatnonzero((robots.age()[:, 0].numpy() >= EPISODE) | unstable), rng)
        log.step()
    return log.policy


def train_sectar(_decoder, _names):
    """Co-Reyes et al. 2018, in short: a VAE learns from windows of T = SKILL_STEPS steps of a robot, that may
    span two skills (theirs: an explorer's trajectories, whose actions it clones), and the policy is rewarded
    for steps that the decoder predicts for z ~ N(0, I). Not reproduced: its skills are not followed."""
    robots, rng, submit = start_robots()
    s_dim, a_dim = robots.observe().shape[1], robots.ctrl.shape[1]
    sac, replay = Sac(s_dim, 2, a_dim), Replay(s=s_dim, a=a_dim, s2=s_dim, displacement=2, c=2, z=Z_DIM)
    vae = nn.ModuleDict(dict(decoder=Decoder(Z_DIM, 2, 64), encoder=layers(2 * SKILL_STEPS, 64, 2 * Z_DIM)))
    adam = torch.optim.Adam(vae.parameters(), lr=LEARNING_RATE, fused=True)
    log = Log(make_policy(sac, vae["decoder"], [], STEP_SCALE), robots, rng, replay, sac, vae, adam)
    z = replay.latest(ROBOTS).z

    while sac.updates < UPDATES:
        t = robots.age() % SKILL_STEPS
        z = torch.where(t == 0, torch.randn(ROBOTS, Z_DIM), z)
        c = commands_of(log.policy, z, SKILL_STEPS)[torch.arange(ROBOTS), t[:, 0].long()]
        s = robots.observe()
        a = sac.actor.act(s, c) if replay.added >= WARM_UP else torch.rand(ROBOTS, a_dim) * 2 - 1
        physics = submit(a)
        if replay.added >= max(WARM_UP, ROBOTS * SKILL_STEPS):
            if sac.updates == 0:
                sac.normalise(replay.read(slice(0, replay.added)).s)
            newest = max(ROBOTS * SKILL_STEPS, min(replay.added, RECENT, len(replay.table)))
            last = replay.added - 1 - torch.randint(newest - ROBOTS * (SKILL_STEPS - 1), (MODEL_BATCH,))
            rows = last[:, None] - ROBOTS * torch.arange(SKILL_STEPS).flip(0)  # of one robot each
            x = replay.read(rows % len(replay.table)).displacement / STEP_SCALE
            mean, log_var = vae["encoder"](x.flatten(1)).chunk(2, 1)  # theirs: a bidirectional LSTM
            kl = 0.5 * (mean ** 2 + log_var.exp() - 1 - log_var).sum(1)
            sampled = mean + (0.5 * log_var).exp() * torch.randn_like(mean)
            decoded, log_var = vae["decoder"](sampled, SKILL_STEPS)
            variance = log_var.exp().clamp(min=(0.01 / STEP_SCALE) ** 2)  # at least 1 cm: else no bound
            log_p = -0.5 * (variance.log() + (x - decoded) ** 2 / variance).sum((1, 2))
            model_loss = (kl - log_p).mean()
            adam.zero_grad()
            model_loss.backward()
            adam.step()
            batch = replay.sample(UPDATES_PER_STEP * BATCH)
            r = -REWARD_SCALE * (batch.displacement / STEP_SCALE - batch.c).norm(dim=1)
            log.numbers = sac.learn(batch, batch.c, r) | dict(reward=r.mean(), model_loss=model_loss.detach())
        displacement, unstable = physics.result()
        replay.add(unstable, s=s, a=a, s2=robots.observe(), displacement=displacement, c=c, z=z)
        robots.reset(np.flatnonzero((robots.age()[:, 0].numpy() >= EPISODE) | unstable), rng)
        log.step()
    return log.policy


# -------- measuring and drawing

def traversal(policy, axis, values):
    """Skills with one axis at values, the others at 0 (on a rail the speed at -1: 0 cannot accelerate)."""
    z = torch.zeros(len(values), len(policy.decoder.axes))
    z[:, 0] = -1 if policy.decoder.x_dim == 1 else 0
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    return z


def roll_out(policy, z, run, closed, rng=None, run_in=0):
    """Execute skills z (n, M) with mean actions, run = (T, H_z): places (n, T * H_z + 1, 2 or 1) in metres.
    From rest, or, with rng, from noisy starts; recorded after run_in steps with the first command."""
    robots = common.Robots(common.robot_spec(ROBOT), len(z), THREADS)
    robots.reset(np.arange(len(z)), rng)
    commands = commands_of(policy, z, run[0])
    execute(policy, robots, commands[:, :1], run_in, closed, True)
    poses = [robots.qpos[None].copy(), execute(policy, robots, commands, run[1], closed, True)]
    return np.concatenate(poses)[..., :robots.places].swapaxes(0, 1).astype(np.float32)


def predicted_path(policy, z, run):
    """The decoder's free run of T transitions, each H_z steps long: places (n, T + 1, 2 or 1) in metres."""
    path = run[1] * policy.scale * policy.decoder(z, run[0])[0].cumsum(1)
    return nn.functional.pad(path, (0, 0, 1, 0)).detach().numpy()


def tracking(policy, closed):
    """Tracking error, from rest: RMS(executed end - predicted end) / RMS(predicted end), over a grid of
    z_single (DADS: z), 5 x 5 or on a rail 8, with z_multi = 0; SeCTAR: over 25 draws from the prior."""
    x_dim = policy.decoder.x_dim
    values = torch.linspace(-Z_RANGE, Z_RANGE, 5 if x_dim == 2 else 8)
    z = torch.cartesian_prod(*[values] * x_dim).view(-1, x_dim)
    z = nn.functional.pad(z, (0, len(policy.decoder.axes) - x_dim))
    if METHOD == "sectar":
        z = torch.randn(25, Z_DIM, generator=torch.Generator().manual_seed(0))
    executed = roll_out(policy, z, SINGLE_RUN, closed)[:, -1]
    predicted = predicted_path(policy, z, SINGLE_RUN)[:, -1]
    return math.sqrt(((executed - predicted) ** 2).sum() / max((predicted ** 2).sum(), 1e-12))


def following(policy, closed):
    """Random skills, as a planner draws them, from STARTS noisy starts: three one after another (a baseline:
    one). Following error: |executed end - end of the commands| of a skill, metres, its median and 90 %; the
    median against the decoder's free run too, which is what "printed" plans with; the share of robots that
    ever turn over; the speed, metres a step."""
    rng, (length, hold) = np.random.default_rng(SEED), MULTI_RUN
    robots = common.Robots(common.robot_spec(ROBOT), STARTS, THREADS)
    robots.reset(np.arange(STARTS), rng)
    fallen, away, away_free, speeds = np.zeros(STARTS, bool), [], [], []
    for _ in range(3 if METHOD == "wedis" else 1):
        z = torch.from_numpy(rng.uniform(-Z_RANGE, Z_RANGE, (STARTS, len(policy.decoder.axes)))).float()
        if "direction" in policy.names:
            z[:, 0].abs_()  # no slow skills, App. A.1.4; on a rail the sign of the speed is the direction
        commands, start = commands_of(policy, z, length), robots.place().numpy()
        free = predicted_path(policy, z, MULTI_RUN)[:, -1]
        asked = hold * policy.scale * commands.sum(1).numpy() if METHOD == "wedis" else free
        poses = execute(policy, robots, commands, hold, closed, True)
        up = 1 - 2 * (poses[..., 4:6] ** 2).sum(-1) if ROBOT == "ant" else np.cos(poses[..., 2])
        fallen |= (up < 0).any(0)  # up: the vertical part of the torso's z axis
        places = np.concatenate([start[None], poses[hold - 1::hold, :, :robots.places]])
        away.append(np.linalg.norm(places[-1] - start - asked, axis=1))
        away_free.append(np.linalg.norm(places[-1] - start - free, axis=1))
        speeds.append(np.linalg.norm(np.diff(places, axis=0), axis=2) / hold)
    return dict(follow_median_m=np.median(away), follow_p90_m=np.quantile(away, 0.9), fall_rate=fallen.mean(),
                follow_decoder_m=np.median(away_free), speed_m_per_step=np.mean(speeds))


def executed_cross_talk(policy, ranges, closed):
    """cross_talk of executed skills, a displacement for each transition, the mean of NOISY starts."""
    values, curves, (length, hold) = np.linspace(-Z_RANGE, Z_RANGE, TRAVERSAL), [], MULTI_RUN
    for axis in range(len(policy.names)):
        z = traversal(policy, axis, values).repeat(NOISY, 1)
        places = roll_out(policy, z, MULTI_RUN, closed, np.random.default_rng(SEED + 1), hold)[:, ::hold]
        steps = np.diff(places, axis=1).reshape(NOISY, TRAVERSAL, length, -1).mean(0)
        curves.append(factors_of(steps / (hold * policy.scale), list(ranges)))
    return common.cross_talk(curves, ranges)


def measure(policy, ranges, config):
    """Print and write a row of results/policies.csv. tracking_error, .._open: open loop; others: closed."""
    row = dict(experiment=EXPERIMENT, method=METHOD, robot=ROBOT, seed=SEED, updates=policy.updates,
               env_steps=policy.env_steps, threads=policy.config["THREADS"],
               train_minutes=policy.seconds / 60)
    for closed, end in ((False, "_open"), (True, "")) if METHOD == "wedis" else ((False, "_open"),):
        row["tracking_error" + "_closed" * closed] = tracking(policy, closed)
        row |= {name + end: value for name, value in following(policy, closed).items()}
        purity = executed_cross_talk(policy, ranges, closed)[1] if policy.names else ()
        row |= {f"purity_{name}{end}": value for name, value in zip(policy.names, purity)}
    for name, value in row.items():
        print(f"{name:24} {value if isinstance(value, str) else round(value, 3)}")
    made = {k: v for k, v in common.made_by(config).items() if k not in ("OUT", "FIGURE", "TRAIN", "RESUME")}
    row["settings"] = common.digest(made | dict(policy=policy.sha256))
    common.update_csv(Path(OUT) / "results" / "policies.csv", [row], ("experiment", "seed", "settings"))


def follow_one_skill(policy, source):
    """The example that 01, 02 and 03 follow: its command, and a step of the robot after 40 steps of it."""
    if METHOD != "wedis" or not source.get("example"):
        return
    z = torch.tensor([[v if name in SINGLE else 0.0 for name, v in zip(policy.names, source["example"])]])
    mean, log_var = (out[:, 0] for out in policy.decoder(z, 1))
    places = roll_out(policy, z, (1, 41), True)[0]
    step = torch.from_numpy(places[-1:] - places[-2:-1])
    (x, y), (dx, dy) = (policy.scale * mean[0]).tolist(), step[0].tolist()
    print("one skill, followed: (z_single, 0) =", *(f"{value:.2f}" for value in z[0].tolist()))
    print(f"  command: the decoder's first displacement times {policy.scale:g}: ({x:.3f}, {y:.3f}) m a step")
    print(f"  the robot's 41st step with it: ({dx:.3f}, {dy:.3f}) m; reward (Eq. 6) "
          f"{reward(mean, log_var, step, FLOOR_END).item():.3f}, 0 at best")


def draw_skills(policy):
    """Fig 5, 15, 16: predicted and executed skills, a column per axis. On a rail y is the latent."""
    names = policy.names or [str(i + 1) for i in range(Z_DIM)]
    loops = (False, True) if METHOD == "wedis" else (False,)  # baselines have no closed loop
    rail = policy.decoder.x_dim == 1
    figure, axes = plt.subplots(1 + len(loops), len(names), squeeze=False, sharex="col", sharey="col",
                                figsize=(2.8 * len(names) + 1, 2.8 + 2.8 * len(loops)))
    for i, name in enumerate(names):
        run = MULTI_RUN if rail or name in MULTI else SINGLE_RUN
        values = np.linspace(-1, 1, 5)
        colours = ["#D55E00", "#009E73", "#0072B2", "#56B4E9", "#F0E442"]  # as the paper's
        z = traversal(policy, i, values)
        paths = [predicted_path(policy, z, run), *(roll_out(policy, z, run, closed) for closed in loops)]
        for ax, path in zip(axes[:, i], paths):
            if rail:
                path = np.dstack([path[..., 0], values[:, None] + 0 * path[..., 0]])
            every = (path.shape[1] - 1) // run[0] if run[0] < 9 else []  # dots: the ends of few transitions
            for line, value, colour in zip(path, values, colours):
                ax.plot(*line.T, "o-", color=colour, lw=1.3, ms=3, markevery=every, label=f"{value:g}")
        enlarged = "" if rail or name != "speed" else ", y enlarged"  # speeds lie on one line
        for ax in axes[:, i]:
            ax.axis("auto" if rail or enlarged else "square")
        axes[0, i].set_title(f"$z_{{{name}}}$, $T$ = {run[0]}, $H_z$ = {run[1]}{enlarged}")
        axes[-1, i].set_xlabel("x (m)")
    for ax, text in zip(axes[:, 0], ("predicted", "executed, open loop", "executed, closed loop")):
        ax.set_ylabel(f"{text}\n{'latent' if rail else 'y (m)'}")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), title="latent", loc="outside right upper")
    common.save_figure(figure, OUT, FIGURE or f"skills_{EXPERIMENT}")


if __name__ == "__main__":
    main()

"""Stage 3: decoder -> skill policy pi(a | s, c), trained by SAC on single steps (Sec. 4.2, Alg. 1, A.1.3).

In: wetvae_<DECODER>_seed<n>.pt of stage 2. The command c of a skill z_single is the decoder's first
displacement. The reward is the decoder's log-likelihood of the step that the robot makes (Eq. 6).
Out: runs/policy_<experiment>_seed<seed>.pt, Fig 5 (15, 16) and a row of runs/results/policies.csv.
Takes 12 to 16 minutes on two cores (135 to 112 updates/s). Expect, mean of 3 seeds: tracking error 0.14
in open loop, 0.04 in closed loop; there, median following error 0.06 m, and 1 % of the robots turn over.
"""
import copy
import math
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

from common import (CORRECTION, HERE, MULTI, SINGLE, Actor, Decoder, Robots, artifact_name,  # before mujoco
                    commands_of, cross_talk, execute, factors_of, layers, load, parse_flags, plt, save,
                    save_figure, stop, update_csv)
import mujoco
import numpy as np
import torch
from torch import nn

EXPERIMENT = "ant_semi"  # row of EXPERIMENTS below
SEED = 0                 # random seed
OUT = "runs"             # folder that everything is written to
TRAIN = True             # false: only measure and draw what is already trained
RESUME = False           # true: continue from the last checkpoint
THREADS = 2              # CPU threads; 1: updates wait for the robots' step, with the same result
REPORTS = 20             # printed lines, points of the learning curve, and checkpoints

METHOD = "wedis"         # wedis, dads or sectar
DECODER = "main"         # experiment of 02 whose decoder is the reward
DECODER_SEED = 0         # and its seed
ROBOT = "ant"            # ant or half_cheetah
STEP_SCALE = 0.1         # metres per trajectory unit, App. A.1.3: 1/10, Half-Cheetah 1/5
VARIANCE_SCALE = 0.003   # decoder variance -> square metres (A.1.3: 1/20, which leaves fast skills too slow)
BASE_FRAME = True        # networks read state and command in the base frame (the paper: in the world's)

UPDATES = 100_000        # updates of the critics (the paper: 1.92 million)
ROBOTS = 256             # robots that step together
EPISODE = 200            # steps until a robot starts anew; no terminal state: the value goes on
SKILL_STEPS = 25         # steps until a robot is given a new skill
WARM_UP = 10_000         # steps with random actions; their statistics normalise the state
REPLAY = 1_000_000       # steps in the replay buffer R; at least two skills of all robots
UPDATES_PER_STEP = 8     # updates in each step of all robots
BATCH = 256              # App. A.1.3
RELABELLED = 0.5         # share of a batch that is relabelled with a fresh skill (the paper: 0)
CORRECTED = 0.25         # share of skills with a random correction, as the closed loop adds it (the paper: 0)

HIDDEN = 256             # width of both hidden layers (the paper: 512; Half-Cheetah 256)
LEARNING_RATE = 1e-3     # Adam (the paper: 3e-4, fixed)
DECAY_FROM = 0.5         # share of the updates after which it falls linearly to 0
ACTOR_EVERY = 2          # updates of the critics for each of actor and value network (usual: 1)
AVERAGED = 0.002         # rate of the running average of the actor's weights, which is the policy
DISCOUNT = 0.98          # gamma of Eq. 1 (the paper: 0.99): a shorter horizon teaches to follow sooner
SMOOTHING = 0.01         # of the target value network, App. A.1.3
REWARD_SCALE = 0.1       # of Eq. 6 (the paper: 1)
TEMPERATURE = 0.003      # alpha, weight of the entropy (the paper: 0.01, which is 0.001 at our reward scale)
FLOOR_START = 0.04       # metres, least standard deviation in the reward; if small, robots stand still
FLOOR_END = 0.01         # the same from 60 % of the updates on; it shrinks after 15 %: teaches slow skills

# Baselines only
Z_DIM = 2                # entries of z: DADS 2, SeCTAR 8
RECENT = 40_000          # latest steps that a baseline's model learns from
MODEL_BATCH = 256        # steps (DADS), trajectories (SeCTAR) in a batch
PRIOR_SAMPLES = 100      # L of DADS's reward
EXPLORE = 0.5            # SeCTAR: share of trajectories of the explorer (0.0: no explorer)
EXPLORER = 3.0           # last entry of an explorer's z, and length of its commands
KL_WEIGHT = 2.0          # SeCTAR: of the KL divergence in its ELBO

# Measuring only: never an obstacle to --resume
Z_RANGE = 1.5            # the axes of z are measured from -Z_RANGE to Z_RANGE
SINGLE_RUN = (1, 100)    # T and H_z of the tracking error and of Fig 5 for z_single, Sec. 6.1.2
MULTI_RUN = (5, 40)      # T and H_z of the following error, of purity and of Fig 5 for z_multi
TRAVERSAL = 13           # skills on each axis at which purity is measured
NOISY = 16               # noisy starts that are averaged for purity
STARTS = 400             # noisy starts of the following error
FIGURE = ""              # name of the figure of skills ("": skills_<experiment>)

SECTAR = dict(METHOD="sectar", UPDATES=66_000, Z_DIM=8, SKILL_STEPS=50, RECENT=512_000, MODEL_BATCH=128,
              REWARD_SCALE=1.0, SINGLE_RUN=(50, 1), MULTI_RUN=(50, 1))  # as many minutes as WEDIS
EXPERIMENTS = {  # a row names the constants in which an experiment differs
    "ant_semi": dict(FIGURE="fig05_skills_wedis"),
    "ant_full": dict(DECODER="full_circle", FIGURE="fig15_full_circle"),
    "half_cheetah": dict(DECODER="speed_acc", ROBOT="half_cheetah", STEP_SCALE=0.2, BASE_FRAME=False,
                         VARIANCE_SCALE=0.05, ROBOTS=64, SKILL_STEPS=100, CORRECTED=0.5, DISCOUNT=0.97,
                         Z_RANGE=1.0, MULTI_RUN=(6, 20), FIGURE="fig16_half_cheetah"),
    "ant_world_frame": dict(BASE_FRAME=False),  # the paper's frame
    "ant_dads": dict(METHOD="dads", Z_RANGE=1.0, SKILL_STEPS=200, FIGURE="fig05_skills_dads"),
    "ant_sectar": SECTAR | dict(FIGURE="fig05_skills_sectar"),
    "ant_sectar_no_explorer": SECTAR | dict(EXPLORE=0.0),  # what the explorer is good for
}
MAY_DIFFER = ("OUT TRAIN RESUME THREADS REPORTS UPDATES Z_RANGE SINGLE_RUN MULTI_RUN TRAVERSAL NOISY STARTS "
              "FIGURE").split()  # from those of a checkpoint

# -------- SAC (Haarnoja et al. 2017), App. A.1.3

class Critics(nn.Module):
    """Q_1 and Q_2 side by side, as batched matrix products: faster than two. (B, n), (B, m) -> (2, B)."""

    def __init__(self, n_in):
        super().__init__()
        networks = [layers(n_in, HIDDEN, 1)[::2] for _ in range(2)]  # their linear layers
        pairs = list(zip(*networks))
        self.weights = nn.ParameterList(torch.stack([a.weight.T, b.weight.T]).detach() for a, b in pairs)
        self.biases = nn.ParameterList(torch.stack([a.bias, b.bias])[:, None].detach() for a, b in pairs)

    def forward(self, x, a):
        h = torch.cat([x, a], 1).expand(2, -1, -1)
        h = torch.relu(torch.baddbmm(self.biases[0], h, self.weights[0]))
        h = torch.relu(torch.baddbmm(self.biases[1], h, self.weights[1]))
        return (h * self.weights[2].mT).sum(2) + self.biases[2].squeeze(2)


class Sac(nn.Module):
    """Actor psi, twin critics, value and target network, with a fixed temperature. average: the policy,
    a running average of the actor's weights."""

    def __init__(self, s_dim, c_dim, a_dim):
        super().__init__()
        self.actor = Actor(s_dim, c_dim, a_dim, HIDDEN, BASE_FRAME)
        n_in = self.actor.net[0].in_features
        self.critics = Critics(n_in + a_dim)
        self.value = layers(n_in, HIDDEN, 1)
        self.target = copy.deepcopy(self.value).requires_grad_(False)
        self.average = copy.deepcopy(self.actor).requires_grad_(False)
        self.critic_adam = torch.optim.Adam(self.critics.parameters(), fused=True)
        self.actor_adam = torch.optim.Adam([*self.actor.parameters(), *self.value.parameters()], fused=True)
        self.updates = 0

    def normalise(self, s):
        """Fix the mean and deviation of the state, from random steps s (N, s_dim)."""
        x = self.actor.inputs(s, torch.zeros(len(s), self.actor.arguments[1]))[:, :len(self.actor.s_mean)]
        self.actor.s_mean.copy_(x.mean(0))
        self.actor.s_std.copy_(x.std(0).clamp(min=1e-3))
        self.average.load_state_dict(self.actor.state_dict())

    def update(self, x, a, x2, r):
        """One update; no step is terminal. x, x2 (B, n): Actor.inputs before and after the step; a (B, m);
        r (B,). Returns a loss, to detect nan."""
        with torch.no_grad():
            q_target = r + DISCOUNT * self.target(x2).squeeze(1)
        q_loss = 0.5 * ((self.critics(x, a) - q_target) ** 2).mean(1).sum()
        self.critic_adam.zero_grad()
        q_loss.backward()
        self.critic_adam.step()
        self.updates += 1
        if self.updates % ACTOR_EVERY:
            return q_loss.item()
        a_new, log_prob = self.actor(x)
        self.critics.requires_grad_(False)  # or backward computes their gradients too
        q_new = self.critics(x, a_new).min(0).values
        self.critics.requires_grad_(True)
        actor_loss = (TEMPERATURE * log_prob - q_new).mean()
        v_loss = 0.5 * ((self.value(x).squeeze(1) - (q_new - TEMPERATURE * log_prob).detach()) ** 2).mean()
        loss = actor_loss + v_loss  # they share no parameter
        self.actor_adam.zero_grad()
        loss.backward()
        self.actor_adam.step()
        with torch.no_grad():
            torch._foreach_lerp_([*self.target.parameters()], [*self.value.parameters()], SMOOTHING)
            torch._foreach_lerp_([*self.average.net.parameters()], [*self.actor.net.parameters()], AVERAGED)
        return loss.item()


# -------- Algorithm 1, policy training

def reward(mean, log_var, displacement, floor):
    """log p of Eq. 6 for one step, (B,), without its normaliser, which depends on the skill alone. mean,
    log_var (B, 2 or 1): trajectory units; displacement, floor: metres. Eq. 6's entropy is in Sac.update."""
    variance = (VARIANCE_SCALE * log_var.exp()).clamp(min=floor ** 2)
    return REWARD_SCALE * -0.5 * ((displacement - STEP_SCALE * mean) ** 2 / variance).sum(1)


def train_wedis(run):
    """Alg. 1, the second loop: train run.sac to follow the decoder's single steps."""
    x_dim, m1 = run.decoder.x_dim, run.z.shape[1] - run.decoder.x_dim

    def draw(n):
        """z_single ~ prior and, beside it, a correction of the command as the closed loop adds it."""
        length = CORRECTION * torch.rand(n, 1).sqrt() * (torch.rand(n, 1) < CORRECTED)  # uniform in a disc
        correction = length * nn.functional.normalize(torch.randn(n, x_dim))
        return torch.cat([torch.randn(n, m1), correction], 1)

    def command_of(z):
        """z of draw -> mean plus correction, and log-variance, of the step, (n, 2 or 1) each."""
        mean, log_var = run.decoder(z[:, :m1], 1)  # Alg. 1: z = (z_single, 0)
        return mean[:, 0] + z[:, m1:], log_var[:, 0]

    while run.sac.updates < UPDATES:
        run.renew(draw(ROBOTS))  # Alg. 1: sample z_single from the prior
        command, _ = command_of(run.z)
        run.act(command)  # Alg. 1: execute actions; the physics runs on the second core from here on

        if run.warm():
            shrunk = min(1, max(0, (run.sac.updates / UPDATES - 0.15) / 0.45))
            floor = FLOOR_START * (FLOOR_END / FLOOR_START) ** shrunk
            s, a, s2, displacement, z = run.sample(UPDATES_PER_STEP * BATCH)  # Alg. 1: sample a batch
            fresh = torch.rand(len(z), 1) < RELABELLED
            z = torch.where(fresh, draw(len(z)), z)  # any stored step can be judged by any skill
            command, log_var = command_of(z)
            r = reward(command, log_var, displacement, floor)  # Alg. 1: compute the reward, Eq. 6
            run.learn(s, a, s2, command, command, r)  # Alg. 1: optimize psi and the critics with the SAC
        run.collect()  # Alg. 1: the samples go to the replay buffer R


def make_robots(n, threads):
    return Robots(mujoco.MjSpec.from_file(str(HERE / f"{ROBOT}.xml")), n, threads)


class Run:
    """What the three loops share: robots, replay buffer, SAC, clock, reports and checkpoints."""

    def __init__(self, decoder, names, z_dim, c_dim, fixed, model=None):
        self.decoder, self.names, self.fixed = decoder, names, fixed
        self.rng = np.random.default_rng(SEED)
        self.robots = make_robots(ROBOTS, 1)
        self.robots.reset(np.arange(ROBOTS), self.rng)
        s_dim, a_dim = self.robots.observe().shape[1], self.robots.ctrl.shape[1]
        self.sac = Sac(s_dim, c_dim, a_dim)
        self.parts = [self.sac, self.sac.critic_adam, self.sac.actor_adam]
        if model:  # what else a baseline learns
            self.model = nn.ModuleDict(model)
            self.adam = torch.optim.Adam(self.model.parameters(), lr=LEARNING_RATE, fused=True)
            self.parts += [self.model, self.adam]
        self.widths = (s_dim, a_dim, s_dim, self.robots.places, z_dim)  # s, a, s', displacement, z
        block = ROBOTS * SKILL_STEPS
        self.replay = torch.zeros(max(2, REPLAY // block) * block, sum(self.widths))
        self.z = torch.zeros(ROBOTS, z_dim)
        self.age = self.rng.integers(0, EPISODE, ROBOTS)  # each robot changes skills at its own time
        if METHOD == "sectar":
            self.age -= self.age % SKILL_STEPS  # together: trajectories are rows of the replay buffer
        self.steps, self.seconds, self.curve, self.losses = 0, 0.0, [], {}
        self.worker, self.clock = ThreadPoolExecutor(1), time.time()
        if RESUME:
            self.resume()

    def renew(self, z):
        """Take new skills z (ROBOTS, z_dim) for the robots whose SKILL_STEPS are over."""
        over = torch.from_numpy(self.age % SKILL_STEPS == 0)
        self.z = torch.where(over[:, None], z, self.z)

    def act(self, command):
        """Begin one step of all robots: a ~ pi(a | s, c), random during the warm-up. collect ends it."""
        s = self.robots.observe()
        a = self.sac.actor.act(s, command)
        if self.steps * ROBOTS < WARM_UP:
            a = torch.rand(a.shape) * 2 - 1
        step = self.worker.submit(self.robots.step, a.numpy())
        if THREADS == 1:
            step.result()
        self.begun = s, a, step

    def warm(self):
        """Whether the warm-up is over. At its end the statistics of the state are fixed."""
        if self.steps * ROBOTS < WARM_UP:
            return False
        if self.sac.updates == 0:
            self.sac.normalise(self.replay[:self.steps * ROBOTS, :self.widths[0]])
        return True

    def sample(self, n, recent=None):
        """n random steps, of the `recent` latest ones: s, a, s', displacement in metres, z."""
        filled = min(self.steps * ROBOTS, len(self.replay))
        back = torch.randint(min(recent or filled, filled), (n,))
        return self.replay[(self.steps * ROBOTS - 1 - back) % len(self.replay)].split(self.widths, 1)

    def learn(self, s, a, s2, c, c2, r):
        """SAC updates, one for each BATCH of steps; c, c2: the commands before and after."""
        left = 1 - self.sac.updates / UPDATES
        for group in self.sac.critic_adam.param_groups + self.sac.actor_adam.param_groups:
            group["lr"] = LEARNING_RATE * min(1, left / max(1 - DECAY_FROM, 1e-9))
        x, x2 = self.sac.actor.inputs(s, c), self.sac.actor.inputs(s2, c2)
        for batch in zip(*(part.split(BATCH) for part in (x, a, x2, r))):
            loss = self.sac.update(*batch)
        self.losses = dict(reward=r.mean().item(), loss=loss)

    def collect(self):
        """End the step: fill the replay buffer, start old robots anew, report and save a checkpoint."""
        s, a, step = self.begun
        displacement, failed = step.result()
        rows = (self.steps * ROBOTS + torch.arange(ROBOTS)) % len(self.replay)
        self.replay[rows] = torch.cat([s, a, self.robots.observe(), displacement, self.z], 1)
        self.replay[rows[failed]] = self.replay[rows[failed] - ROBOTS]  # they mean nothing: repeat the last
        self.steps += 1
        self.age = (self.age + 1) % EPISODE
        self.robots.reset(np.flatnonzero((self.age == 0) | failed), self.rng)
        self.seconds += time.time() - self.clock
        if not all(math.isfinite(value) for value in self.losses.values()):
            stop(f"a loss is not finite after {self.sac.updates} updates: {self.losses}; lower "
                 "--learning_rate, or --resume true from the last good checkpoint", code=1)
        reported = self.curve[-1]["updates"] if self.curve else 0
        if self.sac.updates >= min(UPDATES, reported + UPDATES / REPORTS):
            self.report()
        self.clock = time.time()

    def report(self):
        """One line, one point of the learning curve, and a checkpoint."""
        policy = SimpleNamespace(actor=self.sac.average, decoder=self.decoder, names=self.names,
                                 scale=STEP_SCALE, method=METHOD, relation={})  # in the grid z_multi is 0
        row = dict(updates=self.sac.updates, env_steps=self.steps * ROBOTS, minutes=self.seconds / 60,
                   tracking_error=tracking(policy, False))
        if self.names:
            row["tracking_error_closed"] = tracking(policy, True)
        self.curve.append(row | self.losses)
        text = [f"{name} {round(value, 3)}" for name, value in self.curve[-1].items()]
        left = self.seconds / 60 * (UPDATES / self.sac.updates - 1)
        speed = self.sac.updates / self.seconds
        print(*text, f"{speed:.0f} updates/s", f"{left:.1f} min left", sep="  ", flush=True)
        save(OUT, "policy-checkpoint", EXPERIMENT, SEED, self.fixed, z=self.z,
             robots=torch.from_numpy(self.robots.batch.state.copy()), age=torch.from_numpy(self.age),
             replay=self.replay[:self.steps * ROBOTS].clone(), curve=self.curve,
             numbers=[self.sac.updates, self.steps, self.seconds], torch_rng=torch.get_rng_state(),
             numpy_rng=self.rng.bit_generator.state, parts=[part.state_dict() for part in self.parts])

    def resume(self):
        if not (Path(OUT) / artifact_name("policy-checkpoint", EXPERIMENT, SEED)).exists():
            return print("there is no checkpoint yet")
        state = load(OUT, "policy-checkpoint", EXPERIMENT, SEED, **self.fixed)
        for part, saved in zip(self.parts, state["parts"]):
            part.load_state_dict(saved)
        self.replay[:len(state["replay"])] = state["replay"]
        self.z, self.age, self.curve = state["z"], state["age"].numpy(), state["curve"]
        self.sac.updates, self.steps, self.seconds = state["numbers"]
        self.robots.batch.state[:] = state["robots"].numpy()
        torch.set_rng_state(state["torch_rng"])
        self.rng.bit_generator.state = state["numpy_rng"]


# -------- main

def main():
    config, _ = parse_flags(globals())
    torch.set_num_threads(1)
    fixed = {name: value for name, value in config.items() if name not in MAY_DIFFER}
    source = load(OUT, "wetvae", DECODER, DECODER_SEED)
    decoder, names = source["decoder"], source["names"]
    check_constants(source)
    torch.manual_seed(SEED)
    if TRAIN:
        shared = fixed | dict(DECODER_SHA256=source["sha256"])
        if METHOD == "wedis":
            m1 = sum(name in SINGLE for name in names)
            run = Run(decoder, names, m1 + decoder.x_dim, decoder.x_dim, shared)
            train_wedis(run)
        else:
            decoder, names = Decoder(Z_DIM, 2, 64), []  # an empty list of names marks a baseline
            model = dict(decoder=decoder)
            if METHOD == "sectar":
                model["encoder"] = layers(2 * SKILL_STEPS, 64, 2 * Z_DIM)
            run = Run(decoder, names, Z_DIM, Z_DIM if METHOD == "dads" else 2, shared, model)
            dict(dads=train_dads, sectar=train_sectar)[METHOD](run)
        save(OUT, "policy", EXPERIMENT, SEED, config, actor=run.sac.average, decoder=decoder, method=METHOD,
             robot=ROBOT, names=names, relation=source["relation"], scale=STEP_SCALE, curve=run.curve,
             updates=run.sac.updates, env_steps=run.steps * ROBOTS, seconds=run.seconds)
    policy = SimpleNamespace(**load(OUT, "policy", EXPERIMENT, SEED, **fixed))
    if policy.names and not torch.equal(policy.decoder.head[2].bias, source["decoder"].head[2].bias):
        stop(f"the policy has another decoder {DECODER}: train anew, or choose another --out")
    measure(policy, source["ranges"])
    draw_skills(policy)


def check_constants(source):
    """Exits with 2 if constants do not fit one another, or the decoder."""
    decoder, names = source["decoder"], source["names"]
    if METHOD not in ("wedis", "dads", "sectar") or ROBOT not in ("ant", "half_cheetah"):
        stop("--method is wedis, dads or sectar; --robot is ant or half_cheetah")
    if ROBOT != "ant" and (BASE_FRAME or METHOD != "wedis"):
        stop(f"the {ROBOT} runs on a rail: --base_frame false; DADS and SeCTAR need --robot ant")
    if METHOD == "sectar" and Z_DIM < 3 or METHOD == "dads" and BASE_FRAME and Z_DIM != 2:
        stop("SeCTAR needs --z_dim 3 or more; DADS --z_dim 2, or --base_frame false")
    known = names[0] == "speed" and all(name in SINGLE or MULTI.get(name) in names for name in names)
    if not known or decoder.x_dim != make_robots(1, 1).places:
        stop(f"the decoder {DECODER} has axes {' '.join(names)} and predicts {decoder.x_dim} coordinates: "
             f"the {ROBOT} needs another --decoder")
    if weak := [name for name, corr in zip(names, source["abs_corr"]) if corr < 0.5]:
        print(f"the decoder {DECODER} has no latent that means {' or '.join(weak)}")
    rates = LEARNING_RATE, AVERAGED, SMOOTHING
    if min(STEP_SCALE, VARIANCE_SCALE, *rates, FLOOR_START, FLOOR_END, Z_RANGE) <= 0:
        stop("scales, rates, floors and --z_range must be above 0")
    if DISCOUNT >= 1 or max(RELABELLED, CORRECTED, EXPLORE, AVERAGED, SMOOTHING, DECAY_FROM) > 1:
        stop("--discount is below 1; shares and rates are at most 1")
    if EPISODE % SKILL_STEPS or not all(isinstance(n, int) and n > 0 for n in SINGLE_RUN + MULTI_RUN):
        stop("--skill_steps must divide --episode; --single_run and --multi_run are whole and above 0")


# ======== Baselines: not needed to understand WEDIS

def train_dads(run):
    """Sharma et al. 2019: skills z ~ U(-1, 1)^2. The reward is the mutual information of step and z under the
    skill dynamics q(displacement | z), a Gaussian (theirs: a mixture of four), learnt at the same time. In
    the base frame z is turned as if it were a displacement."""

    def log_q(displacement, z):
        """log q up to a constant: displacement (B, 2), own z (B, 2) -> (B,); (B, 1, 2), (L, 2) -> (B, L)."""
        mean, log_var = (v[:, 0] for v in run.decoder(z, 1))
        variance = log_var.exp().clamp(min=(FLOOR_END / STEP_SCALE) ** 2)  # or likelihoods have no bound
        return -0.5 * (variance.log() + (displacement / STEP_SCALE - mean) ** 2 / variance).sum(-1)

    @torch.no_grad()
    def information(displacement, z):
        """log(L + 1) - log(1 + sum_i exp(log q(.|z_i) - log q(.|z))), (B,); one set of L for the batch."""
        own = log_q(displacement, z)
        others = log_q(displacement[:, None], torch.rand(PRIOR_SAMPLES, Z_DIM) * 2 - 1)
        return math.log(PRIOR_SAMPLES + 1) - (1 + (others - own[:, None]).clamp(-50, 50).exp().sum(1)).log()

    while run.sac.updates < UPDATES:
        run.renew(torch.rand(ROBOTS, Z_DIM) * 2 - 1)
        run.act(run.z)
        if run.warm():
            # from recent steps and their own skills: relabelled ones say nothing about z
            _, _, _, displacement, z = run.sample(MODEL_BATCH, RECENT)
            loss = -log_q(displacement, z).mean()
            run.adam.zero_grad()
            loss.backward()
            run.adam.step()

            s, a, s2, displacement, z = run.sample(UPDATES_PER_STEP * BATCH)
            fresh = torch.rand(len(z), 1) < RELABELLED
            z = torch.where(fresh, torch.rand(z.shape) * 2 - 1, z)
            run.learn(s, a, s2, z, z, REWARD_SCALE * information(displacement, z))
            run.losses["model_loss"] = loss.item()
        run.collect()


def train_sectar(run):
    """Co-Reyes et al. 2018: skills z ~ N(0, I); a VAE learns from the trajectories of an explorer, the same
    policy with very long commands. Reward: of a skill, minus the distance between its end and the decoder's;
    of the explorer, how much farther along its command it ends than the VAE's reconstruction."""
    encoder, decoder = run.model["encoder"], run.decoder

    def elbo(x):
        """x (B, T, 2), trajectory units -> sum_t log p(x_t | z), KL(q || p), (B,), and means (B, T, 2)."""
        mean, log_var = encoder(x.flatten(1)).chunk(2, 1)  # theirs: a bidirectional LSTM
        kl = 0.5 * (mean ** 2 + log_var.exp() - 1 - log_var).sum(1)
        decoded, variance = decoder(mean + (0.5 * log_var).exp() * torch.randn_like(mean), SKILL_STEPS)
        variance = variance.exp().clamp(min=(FLOOR_END / STEP_SCALE) ** 2)  # or likelihoods have no bound
        return -0.5 * (variance.log() + (x - decoded) ** 2 / variance).sum((1, 2)), kl, decoded

    def trajectories(n, recent):
        """n random whole trajectories of the `recent` latest steps: s, a, s', displacement, z (n, T, ..)."""
        block = ROBOTS * SKILL_STEPS
        done = run.steps // SKILL_STEPS
        back = torch.randint(max(1, min(done, len(run.replay) // block - 1, recent // block)), (n,))
        first = (done - 1 - back) % (len(run.replay) // block) * block + torch.randint(ROBOTS, (n,))
        rows = first[:, None] + ROBOTS * torch.arange(SKILL_STEPS)
        return run.replay[rows].split(run.widths, 2)

    def steps_of(z, decoded):
        """Commands (B, T, 2) of skills and explorers alike."""
        return torch.where(z[:, None, -1:] == EXPLORER, z[:, None, :2].expand_as(decoded), decoded)

    while run.sac.updates < UPDATES:
        z = torch.randn(ROBOTS, Z_DIM)
        explorers = torch.rand(ROBOTS) < EXPLORE
        z[explorers, :2] = EXPLORER * nn.functional.normalize(z[explorers, :2])
        z[explorers, -1] = EXPLORER
        run.renew(z)
        with torch.no_grad():
            commands = steps_of(run.z, decoder(run.z, SKILL_STEPS)[0])
        run.act(commands[:, run.steps % SKILL_STEPS])
        if run.warm() and run.steps >= SKILL_STEPS:
            _, _, _, x, z = trajectories(MODEL_BATCH, RECENT)
            used = (z[:, 0, -1] == EXPLORER) | (EXPLORE == 0)
            log_p, kl, _ = elbo(x / STEP_SCALE)
            loss = ((KL_WEIGHT * kl - log_p) * used).sum() / used.sum().clamp(min=1)
            run.adam.zero_grad()
            loss.backward()
            run.adam.step()

            n = max(1, UPDATES_PER_STEP * BATCH // SKILL_STEPS)
            s, a, s2, x, z = trajectories(n, len(run.replay))
            x, z = x / STEP_SCALE, z[:, 0]
            explorer = z[:, -1] == EXPLORER
            fresh = (torch.rand(n) < RELABELLED) & ~explorer
            z[fresh] = torch.randn(int(fresh.sum()), Z_DIM)
            with torch.no_grad():
                decoded = torch.where(explorer[:, None, None], elbo(x)[2], decoder(z, SKILL_STEPS)[0])
            # Laplace likelihood of the end. The trap: that of steps is highest for standing still
            error = x - decoded
            direction = torch.where(explorer[:, None], z[:, :2], -error.sum(1))
            r = REWARD_SCALE * (error * nn.functional.normalize(direction)[:, None]).sum(2)
            c = steps_of(z, decoded)
            c2 = torch.cat([c[:, 1:], c[:, -1:]], 1)
            order = torch.randperm(r.numel())
            run.learn(*(part.flatten(0, 1)[order] for part in (s, a, s2, c, c2, r)))
            run.losses["model_loss"] = loss.item()
        run.collect()


# ======== Measuring and drawing: not needed for WEDIS

def upside_down(robots):
    """Which robots have turned over (n,): the torso's z axis points down."""
    if robots.places == 1:
        return np.cos(robots.qpos[:, 2]) < 0
    return (robots.qpos[:, 4:6] ** 2).sum(1) > 0.5  # of its quaternion: 1 - 2 (x^2 + y^2) < 0


def traversal(policy, axis, values):
    """Skills with one axis at values, the others at 0 (on a rail the speed at -1: 0 cannot accelerate)."""
    z = torch.zeros(len(values), len(policy.names) or Z_DIM)
    if policy.decoder.x_dim == 1:
        z[:, 0] = -1
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    return z


def grid(policy):
    """Skills of the tracking error, z_multi = 0: 5 speeds x 5 directions (full circle: 16; rail: 8 speeds);
    SeCTAR: 25 draws from the prior."""
    if METHOD == "sectar":
        return torch.randn(25, Z_DIM, generator=torch.Generator().manual_seed(0))
    z = torch.linspace(-Z_RANGE, Z_RANGE, 8)[:, None]
    if policy.decoder.x_dim == 2:
        speeds = directions = torch.linspace(-Z_RANGE, Z_RANGE, 5)
        if policy.decoder.circle is not None:
            directions = torch.linspace(-Z_RANGE, Z_RANGE, 17)[:-1]  # the two ends are one direction
        z = torch.cartesian_prod(speeds, directions)
    return nn.functional.pad(z, (0, (len(policy.names) or Z_DIM) - z.shape[1]))


def roll_out(policy, z, run, closed, noise=None, run_in=0):
    """Execute skills z (n, M) with mean actions, run = (T, H_z): places (n, T * H_z + 1, 2 or 1) in metres.
    From rest, or with noise (a seed) from noisy starts; recorded after run_in steps."""
    robots = make_robots(len(z), THREADS)
    if noise is not None:
        robots.reset(np.arange(len(z)), np.random.default_rng(noise))
    commands = commands_of(policy, z, run[0])
    for _ in execute(policy, robots, commands[:, :1], run_in, closed, True):
        pass
    places = [robots.place()]
    for _ in execute(policy, robots, commands, run[1], closed, True):
        places.append(robots.place())
    return torch.stack(places, 1).numpy()


def predicted_path(policy, z, run):
    """The decoder's free run of T transitions, each H_z steps long: places (n, T + 1, 2 or 1) in metres."""
    with torch.no_grad():
        path = run[1] * policy.scale * policy.decoder(z, run[0])[0].cumsum(1)
    return nn.functional.pad(path, (0, 0, 1, 0)).numpy()


def tracking(policy, closed):
    """Tracking error: RMS(executed end - predicted end) / RMS(predicted end) over the grid, from rest."""
    z = grid(policy)
    executed = roll_out(policy, z, SINGLE_RUN, closed)[:, -1]
    predicted = predicted_path(policy, z, SINGLE_RUN)[:, -1]
    return math.sqrt(((executed - predicted) ** 2).sum() / (predicted ** 2).sum())


def following(policy, closed):
    """Following error: three random skills one after another from noisy starts. Returns median and 90 %
    quantile of |end - sum of commands| of a skill, metres, and the share of robots that ever turn over."""
    rng = np.random.default_rng(SEED)
    robots = make_robots(STARTS, THREADS)
    robots.reset(np.arange(STARTS), rng)
    fallen, away = np.zeros(STARTS, bool), []
    for _ in range(3):
        z = torch.from_numpy(rng.uniform(-Z_RANGE, Z_RANGE, (STARTS, len(policy.names)))).float()
        if "direction" in policy.names:
            z[:, 0].abs_()  # no slow skills, App. A.1.4; on a rail the sign of the speed is the direction
        commands = commands_of(policy, z, MULTI_RUN[0])
        predicted = robots.place() + MULTI_RUN[1] * policy.scale * commands.sum(1)
        for _ in execute(policy, robots, commands, MULTI_RUN[1], closed, True):
            fallen |= upside_down(robots)
        away.append((robots.place() - predicted).norm(dim=1).numpy())
    return dict(follow_median_m=float(np.median(away)), follow_p90_m=float(np.quantile(away, 0.9)),
                fall_rate=float(fallen.mean()))


def executed_cross_talk(policy, ranges, closed):
    """cross_talk of executed skills, a displacement for each transition, the mean of NOISY starts."""
    values, curves, (length, hold) = np.linspace(-Z_RANGE, Z_RANGE, TRAVERSAL), [], MULTI_RUN
    for axis in range(len(policy.names)):
        z = traversal(policy, axis, values).repeat(NOISY, 1)
        places = roll_out(policy, z, MULTI_RUN, closed, noise=SEED + 1, run_in=hold)[:, ::hold]
        steps = np.diff(places, axis=1).reshape(NOISY, TRAVERSAL, length, -1).mean(0)
        curves.append(factors_of(steps / (hold * policy.scale), list(ranges)))
    return cross_talk(curves, ranges)


def measure(policy, ranges):
    """Print and write a row of results/policies.csv. tracking_error, .._open: open loop; others: closed."""
    row = dict(experiment=EXPERIMENT, method=METHOD, robot=ROBOT, seed=SEED, updates=policy.updates,
               env_steps=policy.env_steps, threads=policy.config["THREADS"],
               train_minutes=policy.seconds / 60, tracking_error=tracking(policy, False))
    if METHOD == "wedis":
        row["tracking_error_closed"] = tracking(policy, True)
        for closed, end in ((False, "_open"), (True, "")):
            row |= {name + end: value for name, value in following(policy, closed).items()}
            _, purity = executed_cross_talk(policy, ranges, closed)
            row |= {f"purity_{name}{end}": value for name, value in zip(policy.names, purity.tolist())}
    for name, value in row.items():
        print(f"{name:24} {value if isinstance(value, str) else round(value, 3)}")
    update_csv(Path(OUT) / "results" / "policies.csv", [row], ("experiment", "seed"))


def draw_skills(policy):
    """Fig 5, 15, 16: predicted and executed skills, a column per axis. On a rail the latent is on the y axis,
    and transitions have colours."""
    names = policy.names or [str(i + 1) for i in range(Z_DIM)]
    rows = ("predicted", "executed, open loop", "executed, closed loop")[:2 + bool(policy.names)]
    rail = policy.decoder.x_dim == 1
    figure, axes = plt.subplots(len(rows), len(names), squeeze=False, sharex="col", sharey="col",
                                figsize=(2.8 * len(names) + 1, 2.8 * len(rows)))
    for i, name in enumerate(names):
        run = MULTI_RUN if rail or name in MULTI else SINGLE_RUN
        values = np.linspace(-1, 1, 9 if rail else 5)
        colours = ["#D55E00", "#009E73", "#0072B2", "#56B4E9", "#F0E442"]  # as the paper's
        if name == "direction" and policy.decoder.circle is not None:
            values = np.linspace(-1.5, 1.5, 17)[:-1]
            colours = plt.get_cmap("twilight")(np.linspace(0.1, 0.9, len(values)))
        z = traversal(policy, i, values)
        paths = [predicted_path(policy, z, run)]
        paths += [roll_out(policy, z, run, closed) for closed in (False, True)[:len(rows) - 1]]
        for ax, path in zip(axes[:, i], paths):
            marks = path[:, ::1 if path is paths[0] else run[1]]
            if rail:
                for t, colour in enumerate(plt.get_cmap("plasma")(np.linspace(0, 0.85, marks.shape[1]))):
                    ax.plot(marks[:, t, 0], values, ".", color=colour, label=f"t = {t}")
                continue
            for line, dots, value, colour in zip(path, marks, values, colours):
                ax.plot(*line.T, color=colour, lw=1.3, label=f"{value:g}")
                ax.plot(*dots.T, "o", ms=3 if len(dots) < 10 else 0, color=colour)
        for ax in axes[:, i]:
            ax.axis("auto" if rail else "square")  # one scale for the column
        axes[0, i].set_title(f"$z_{{{name}}}$, $T$ = {run[0]}, $H_z$ = {run[1]}")
        axes[-1, i].set_xlabel("x (m)")
    for ax, text in zip(axes[:, 0], rows):
        ax.set_ylabel(f"{text}\n{'latent' if rail else 'y (m)'}")
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, title="transition" if rail else "latent", loc="outside right upper")
    save_figure(figure, OUT, FIGURE or f"skills_{EXPERIMENT}")


if __name__ == "__main__":
    main()

"""Speed against what a user would take instead, by hand on an idle machine: `pip install stable-baselines3 imageio` first.

python tests/bench.py            3 minutes. Critic updates/s at two layers of 256 and batches of 256 against Stable-Baselines3's
                                 gradient steps (ours: actor and value network in each second one); environment steps/s against
                                 Gymnasium's vector Ant-v5 and bare mj_step; plans/s of 04 in Maze 1, dense, with 1000 and 10,000
                                 samples; updates/s of the whole loop on one core and on two.
                                 One thread, or as it says; the median of five rounds in turns, a busy moment hits all.
python tests/bench.py tracking   as many minutes as the shipped ant_semi policies took: Stable-Baselines3's SAC with its defaults on
                                 the same task (robot, base frame, commands, reward), with as many threads, then its error beside ours.
Writes results/bench.csv."""
import contextlib
import io
import sys
import tempfile
import time
import warnings
from types import SimpleNamespace

from conftest import ROOT, robot_spec, script  # first: it makes common known
import common
import gymnasium
import mujoco
import numpy as np
import torch

S, C, A, BATCH, ROUNDS = 26, 2, 8, 256, 5
torch.set_num_threads(1)
warnings.filterwarnings("ignore")
s3 = script("03_train_policy")


def rate(work, count):
    """A function that runs work() until half a second is over and returns count * runs / seconds."""
    def measure():
        runs, start = 0, time.perf_counter()
        while time.perf_counter() - start < 0.5:
            work()
            runs += 1
        return count * runs / (time.perf_counter() - start)
    work()
    return measure


def our_updates():
    sac = s3.Sac(S + 1, C, A)
    x, a, x2, r = torch.randn(BATCH, S + C), torch.rand(BATCH, A), torch.randn(BATCH, S + C), torch.randn(BATCH)
    return lambda: sac.update(x, a, x2, r)


def sb3_updates():
    from stable_baselines3 import SAC
    from stable_baselines3.common.logger import configure
    env = gymnasium.make("Ant-v5")
    space = gymnasium.spaces.Box(-np.inf, np.inf, (S + C,), np.float64)
    env = gymnasium.wrappers.TransformObservation(env, lambda observation: np.zeros(S + C), space)
    model = SAC("MlpPolicy", env, buffer_size=2000, batch_size=BATCH, ent_coef=0.01, policy_kwargs=dict(net_arch=[256, 256]),
                device="cpu")
    model.set_logger(configure(None, []))
    for _ in range(1000):
        model.replay_buffer.add(np.random.randn(1, S + C), np.random.randn(1, S + C), np.random.rand(1, A), np.zeros(1),
                                np.zeros(1), [{}])
    return lambda: model.train(gradient_steps=4, batch_size=BATCH)


def our_robots(threads):
    robots, action = common.Robots(robot_spec("ant"), 64, threads), np.random.uniform(-1, 1, (64, 8))

    def step():
        robots.observe()
        robots.step(action)
    return step


def bare_mj_step():
    model = robot_spec("ant").compile()
    data = mujoco.MjData(model)
    action = np.random.uniform(-1, 1, 8)

    def step():
        data.ctrl[:] = action
        mujoco.mj_step(model, data, nstep=5)
    return step


def gymnasium_vector():
    envs = gymnasium.make_vec("Ant-v5", num_envs=8, vectorization_mode="sync", terminate_when_unhealthy=False)
    envs.reset()
    action = np.random.uniform(-1, 1, (8, 8))
    return lambda: envs.step(action)


def plans(samples):
    """One plan of Algorithm 2 from the start: three skills, in Maze 1, dense, with the shipped policy."""
    stage = script("04_mpc_maze")
    flags = f"--mazes maze1 --rewards dense --modes commands --samples {samples} --out {tempfile.gettempdir()}"
    (case, policy, _), = stage.check(*common.parse_flags(vars(stage), flags.split()))
    pool = stage.skill_pool(case, policy)
    return lambda: stage.plan(case, policy, pool, case.planned, torch.zeros(2))


def whole_loop(threads):
    """Updates/s of 03 from its own printed line, 4000 updates."""
    with tempfile.TemporaryDirectory() as out, contextlib.redirect_stdout(io.StringIO()) as text:
        stage, sys.argv = script("03_train_policy"), ["03", "--updates", "4000", "--reports", "1", "--threads", str(threads),
                                                      "--out", out]
        stage.measure = stage.draw_skills = lambda *_: None
        stage.main()
    return float(text.getvalue().split(" updates/s")[0].split()[-1])


# ---------------------------------------------------------------- the same task for Stable-Baselines3

class Follow(gymnasium.Env):
    """One Ant that is to follow commands, as in 03: what it sees is Actor.inputs without the normalisation, a new skill every
    SKILL_STEPS, the reward of Eq. 6 with the deviation that 03 ends with, an episode of EPISODE steps that is no terminal one."""

    def __init__(self, decoder, seed):
        self.decoder, self.rng, self.robots = decoder, np.random.default_rng(seed), common.Robots(robot_spec("ant"), 1, 1)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (28,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (8,), np.float32)

    def see(self):
        return torch.cat(common.to_base_frame(self.robots.observe(), self.command), 1)[0].numpy()

    def skill(self):
        z = torch.tensor([[*self.rng.normal(size=2), 0.0]], dtype=torch.float32)  # (z_single, 0)
        self.command, self.log_var = (v[:, 0] for v in self.decoder(z, 1))

    def reset(self, seed=None, options=None):
        self.robots.reset(np.array([0]), self.rng)
        self.age = 0
        self.skill()
        return self.see(), {}

    def step(self, action):
        displacement, unstable = self.robots.step(action[None])
        r = 0.0 if unstable[0] else s3.reward(self.command, self.log_var, displacement, s3.FLOOR_END).item() / s3.REWARD_SCALE
        self.age += 1
        if self.age % s3.SKILL_STEPS == 0:
            self.skill()
        return self.see(), r, False, bool(self.age >= s3.EPISODE or unstable[0]), {}


class Theirs:
    """Stable-Baselines3's policy as an actor of ours."""

    def __init__(self, model):
        self.model = model

    def act(self, s, c, deterministic):
        return torch.from_numpy(self.model.predict(torch.cat(common.to_base_frame(s, c), 1).numpy(), deterministic=deterministic)[0])


def tracking_after(minutes, threads):
    """Tracking error (open loop) of Stable-Baselines3's SAC after so many minutes on so many threads."""
    from stable_baselines3 import SAC
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv

    class Clock(BaseCallback):
        start = time.time()

        def _on_step(self):
            if self.n_calls % 2000 == 0:
                print(f"{self.num_timesteps} steps, {(time.time() - self.start) / 60:.1f} min", flush=True)
            return time.time() - self.start < 60 * minutes

    torch.set_num_threads(threads)
    decoder = common.load("pretrained", "wetvae", "main", 0)["decoder"]
    envs = DummyVecEnv([lambda seed=seed: Follow(decoder, seed) for seed in range(4)])
    model = SAC("MlpPolicy", envs, gradient_steps=-1, device="cpu", seed=0)  # an update for each environment step, its default
    model.learn(10 ** 9, callback=Clock())
    policy = SimpleNamespace(actor=Theirs(model), decoder=decoder, names=["speed", "direction", "curvature"], relation={},
                             scale=s3.STEP_SCALE, method="wedis")
    return s3.tracking(policy, False)


def compare_tracking():
    ours = [row for row in common.read_csv(ROOT / "results/policies.csv") if row["experiment"] == "ant_semi"]
    minutes, error = (float(np.mean([float(row[name]) for row in ours])) for name in ("train_minutes", "tracking_error"))
    threads = max(int(row["threads"]) for row in ours)
    return [(f"tracking error after {minutes:.0f} minutes", error, tracking_after(minutes, threads), "Stable-Baselines3 SAC, seed 0",
             f"open loop, mean of {len(ours)} of ours; threads: {threads}; lower is better")]


def speeds():
    measures = dict(ours=rate(our_updates(), 1), sb3=rate(sb3_updates(), 4), robots=rate(our_robots(1), 64),
                    robots2=rate(our_robots(2), 64), plans=rate(plans(1000), 1),
                    more=rate(plans(10_000), 1), mj_step=rate(bare_mj_step(), 1), vector=rate(gymnasium_vector(), 8))
    rounds = [{name: measure() for name, measure in measures.items()} for _ in range(ROUNDS)]
    v = {name: float(np.median([one[name] for one in rounds])) for name in measures}
    return [("SAC updates", v["ours"], v["sb3"], "Stable-Baselines3 SAC", "updates/s, one thread"),
            ("Ant steps", v["robots"], v["vector"], "Gymnasium SyncVectorEnv of 8 Ant-v5", "environment steps/s, one thread"),
            ("Ant steps", v["robots"], v["mj_step"], "bare mj_step of the same Ant", "environment steps/s, one thread"),
            ("Ant steps, two threads", v["robots2"], v["robots"], "ours on one thread", "environment steps/s"),
            ("plans, N = 1000", v["plans"], v["more"], "ours, N = 10,000", "plans of three skills/s, one thread"),
            ("whole training loop", whole_loop(2), whole_loop(1), "ours on one core", "updates/s on two cores")]


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1:] != ["tracking"]:
        sys.exit("usage: python tests/bench.py [tracking]")
    rows = compare_tracking() if sys.argv[1:] else speeds()
    for what, ours, peer, name, unit in rows:
        print(f"{what:24s} {ours:8.3f}   {name:36s} {peer:8.3f}   ratio {ours / peer:5.2f}   {unit}")
    common.update_csv(ROOT / "results/bench.csv", [dict(what=what, ours=ours, peer=peer, peer_name=name, ratio=ours / peer,
                                                        unit=unit) for what, ours, peer, name, unit in rows], ("what", "peer_name"))

"""Timings in one run on one machine, by hand, 2 minutes on an idle one: `pip install stable-baselines3 && python tests/bench.py`.

Critic updates/s at two layers of 256 and batches of 256 against Stable-Baselines3's gradient steps (ours: actor and value
network in each second one); environment steps/s against Gymnasium's vector Ant-v5 and against bare mj_step. One thread, or as it
says; each figure is the median of five rounds, in turns, so that a busy moment hits all. Writes results/bench.csv."""
import time
import warnings

from conftest import ROOT, script  # first: it makes common known
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
    return lambda: sac.update(x, a, x2, r, 0.97)


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
    robots, action = common.Robots(common.robot_spec("ant"), 64, threads), np.random.uniform(-1, 1, (64, 8))

    def step():
        robots.observe()
        robots.step(action)
    return step


def bare_mj_step():
    model = common.robot_spec("ant").compile()
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


if __name__ == "__main__":
    measures = dict(ours=rate(our_updates(), 1), sb3=rate(sb3_updates(), 4), robots=rate(our_robots(1), 64),
                    robots2=rate(our_robots(2), 64), mj_step=rate(bare_mj_step(), 1), vector=rate(gymnasium_vector(), 8))
    rounds = [{name: measure() for name, measure in measures.items()} for _ in range(ROUNDS)]
    v = {name: float(np.median([one[name] for one in rounds])) for name in measures}
    rows = [("SAC updates", v["ours"], v["sb3"], "Stable-Baselines3 SAC", "updates/s, one thread"),
            ("Ant steps", v["robots"], v["vector"], "Gymnasium SyncVectorEnv of 8 Ant-v5", "environment steps/s, one thread"),
            ("Ant steps", v["robots"], v["mj_step"], "bare mj_step of the same Ant", "environment steps/s, one thread"),
            ("Ant steps, two threads", v["robots2"], v["robots"], "ours on one thread", "environment steps/s")]
    for what, ours, peer, name, unit in rows:
        print(f"{what:24s} {ours:8.1f}   {name:36s} {peer:8.1f}   ratio {ours / peer:5.2f}   {unit}")
    common.update_csv(ROOT / "results/bench.csv", [dict(what=what, ours=ours, peer=peer, peer_name=name, ratio=ours / peer,
                                                        unit=unit) for what, ours, peer, name, unit in rows], ())

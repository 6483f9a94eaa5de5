"""Timings in one run on one machine, one thread each: python tests/bench.py (by hand, 3 minutes on an idle machine; needs requirements-dev.txt).

SAC updates/s at two layers of 256 and batches of 256 against Stable-Baselines3 and against a plain loop in the style of CleanRL written here;
environment steps/s against Gymnasium's vector Ant-v5 and against bare mj_step; share of the measured matrix-multiply peak that an
update reaches. Every figure is the median of five rounds, taken in turns so that a busy moment hits all. Writes results/bench.csv."""
import time
import warnings

from conftest import ROOT, script  # first: it makes common known
import common
import gymnasium
import mujoco
import numpy as np
import torch
from torch import nn

S, Z, A, BATCH, ROUNDS = 26, 2, 8, 256, 5
torch.set_num_threads(1)
warnings.filterwarnings("ignore")
s3 = script("03_train_policy")


def rate(work, count):
    """A function that runs work() until half a second has passed and returns count * runs / seconds."""
    def measure():
        runs, start = 0, time.perf_counter()
        while time.perf_counter() - start < 0.5:
            work()
            runs += 1
        return count * runs / (time.perf_counter() - start)
    work()
    return measure


def our_updates():
    actor, critics = common.Actor(S, Z, A, 256), s3.Critics(S + Z + A)
    value, target = s3.value_network(S + Z), s3.value_network(S + Z).requires_grad_(False)
    optimizer = torch.optim.Adam([p for net in (actor, critics, value) for p in net.parameters()], lr=1e-3, fused=True)
    x, a, x2, r = torch.randn(BATCH, S + Z), torch.rand(BATCH, A), torch.randn(BATCH, S + Z), torch.randn(BATCH)

    def update():
        losses = s3.sac_losses(actor, critics, value, target, x, a, x2, r)
        optimizer.zero_grad()
        sum(losses).backward()
        optimizer.step()
        torch._foreach_lerp_(list(target.parameters()), list(value.parameters()), 0.01)
    return update


def plain_updates():
    """Two critics, two targets, one optimiser each, three backward passes, a Python loop over target parameters: no value network."""
    def net(n_in, n_out):
        return nn.Sequential(nn.Linear(n_in, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, n_out))
    policy, q, q_target = net(S + Z, 2 * A), [net(S + Z + A, 1) for _ in range(2)], [net(S + Z + A, 1) for _ in range(2)]
    actor_adam = torch.optim.Adam(policy.parameters(), lr=1e-3)
    q_adam = torch.optim.Adam([p for one in q for p in one.parameters()], lr=1e-3)
    x, a, x2, r = torch.randn(BATCH, S + Z), torch.rand(BATCH, A), torch.randn(BATCH, S + Z), torch.randn(BATCH)

    def act(state):
        mean, log_std = policy(state).chunk(2, 1)
        normal = torch.distributions.Normal(mean, log_std.clamp(-5, 2).exp())
        u = normal.rsample()
        action = torch.tanh(u)
        return action, (normal.log_prob(u) - torch.log(1 - action ** 2 + 1e-6)).sum(1, keepdim=True)

    def update():
        with torch.no_grad():
            a2, log_prob = act(x2)
            y = r[:, None] + 0.97 * (torch.min(*(one(torch.cat([x2, a2], 1)) for one in q_target)) - 0.01 * log_prob)
        loss = sum(nn.functional.mse_loss(one(torch.cat([x, a], 1)), y) for one in q)
        q_adam.zero_grad()
        loss.backward()
        q_adam.step()
        action, log_prob = act(x)
        loss = (0.01 * log_prob - torch.min(*(one(torch.cat([x, action], 1)) for one in q))).mean()
        actor_adam.zero_grad()
        loss.backward()
        actor_adam.step()
        for one, other in zip(q, q_target):
            for p, p_target in zip(one.parameters(), other.parameters()):
                p_target.data.lerp_(p.data, 0.01)
    return update


def sb3_updates():
    from stable_baselines3 import SAC
    env = gymnasium.make("Ant-v5")
    env.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (S + Z,), np.float64)
    model = SAC("MlpPolicy", gymnasium.wrappers.TransformObservation(env, lambda o: np.zeros(S + Z), env.observation_space), buffer_size=2000,
                batch_size=BATCH, ent_coef=0.01, policy_kwargs=dict(net_arch=[256, 256]), device="cpu")
    from stable_baselines3.common.logger import configure
    model.set_logger(configure(None, []))
    for _ in range(1000):
        model.replay_buffer.add(np.random.randn(1, S + Z), np.random.randn(1, S + Z), np.random.rand(1, A), np.zeros(1), np.zeros(1), [{}])
    return lambda: model.train(gradient_steps=4, batch_size=BATCH)


def our_robots(threads):
    robots, action = common.Robots(common.ant_spec(), 64, threads), np.random.uniform(-1, 1, (64, 8))

    def step():
        robots.observe()
        robots.step(action)
    return step


def bare_mj_step():
    model = common.ant_spec().compile()
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


def peak():
    a, b = torch.randn(256, 256), torch.randn(256, 256)
    return lambda: a @ b


if __name__ == "__main__":
    measures = dict(ours=rate(our_updates(), 1), plain=rate(plain_updates(), 1), sb3=rate(sb3_updates(), 4),
                    robots=rate(our_robots(1), 64), robots2=rate(our_robots(2), 64), mj_step=rate(bare_mj_step(), 1),
                    vector=rate(gymnasium_vector(), 8), peak=rate(peak(), 2 * 256 ** 3 / 1e9))
    rounds = [{name: measure() for name, measure in measures.items()} for _ in range(ROUNDS)]
    v = {name: float(np.median([one[name] for one in rounds])) for name in measures}
    flop = 2e-9 * BATCH * (3 * ((S + Z) * 256 + 256 ** 2 + 256 * 2 * A) + 3 * ((S + Z) * 256 + 256 ** 2) + ((S + Z) * 256 + 256 ** 2)
                           + 2 * (3 + 2) * ((S + Z + A) * 256 + 256 ** 2))  # GFLOP an update: forward 1, backward 2, of inputs only 1
    rows = [("SAC updates", v["ours"], v["sb3"], "Stable-Baselines3 SAC", "updates/s, one thread"),
            ("SAC updates", v["ours"], v["plain"], "plain CleanRL-style loop", "updates/s, one thread"),
            ("SAC update's share of peak", v["ours"] * flop, v["peak"], "256 x 256 matrix product", "GFLOP/s, one thread"),
            ("Ant steps", v["robots"], v["vector"], "Gymnasium SyncVectorEnv of 8 Ant-v5", "environment steps/s, one thread"),
            ("Ant steps", v["robots"], v["mj_step"], "bare mj_step of the same Ant", "environment steps/s, one thread"),
            ("Ant steps, two threads", v["robots2"], v["robots"], "ours on one thread", "environment steps/s")]
    print(f"median of {ROUNDS} rounds; an update is {flop:.2f} GFLOP")
    for what, ours, peer, name, unit in rows:
        print(f"{what:28s} {ours:8.1f}   {name:36s} {peer:8.1f}   ratio {ours / peer:5.2f}   {unit}")
    common.update_csv(ROOT / "results/bench.csv", [dict(what=what, ours=ours, peer=peer, peer_name=name, ratio=ours / peer, unit=unit)
                                                   for what, ours, peer, name, unit in rows], ())

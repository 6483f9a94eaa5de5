"""Stage 3, WEDIS: robots against Gymnasium and mj_step, networks and SAC against torch.distributions and autograd,
execution and measures by hand, every row of EXPERIMENTS from training to figures. All networks are tiny."""
import importlib.util
import math
from pathlib import Path
from types import SimpleNamespace

import common
import mujoco
import numpy as np
import pytest
import torch
from conftest import S3, load_policy, one_line, one_pass, robot_spec, script, tiny
from torch import distributions as D
from torch import nn

CLOSE = dict(atol=1e-5, rtol=1e-4)
ROWS = list(script(S3).EXPERIMENTS)

# ---------------------------------------------------------------- robots

FIELDS = """nq nv nu nbody njnt ngeom qpos0 body_parentid body_pos body_mass body_inertia body_ipos jnt_type jnt_axis
jnt_pos jnt_range jnt_limited jnt_stiffness jnt_margin dof_armature dof_damping geom_type geom_size geom_pos geom_quat
geom_friction geom_condim geom_contype geom_conaffinity geom_margin geom_solref geom_solimp geom_bodyid actuator_trnid
actuator_gear actuator_ctrlrange actuator_ctrllimited actuator_gainprm actuator_biasprm""".split()


@pytest.mark.parametrize("robot", ["ant", "half_cheetah"])
def test_robots_are_those_of_gymnasiums_ant_v5_and_halfcheetah_v5(robot):
    """Gymnasium's model file against ours field by field, and through 20 environment steps."""
    folder = Path(importlib.util.find_spec("gymnasium").origin).parent
    model = mujoco.MjModel.from_xml_path(str(folder / f"envs/mujoco/assets/{robot}.xml"))
    spec = robot_spec(robot)
    ours, data = spec.compile(), mujoco.MjData(model)
    for field in FIELDS:
        np.testing.assert_allclose(getattr(ours, field), getattr(model, field), atol=1e-12, err_msg=field)
    for field in "timestep integrator gravity solver cone iterations tolerance density viscosity impratio".split():
        np.testing.assert_array_equal(getattr(ours.opt, field), getattr(model.opt, field), field)
    robots, rng = common.Robots(spec, 3, 1), np.random.default_rng(0)
    rest = model.numeric("init_qpos").data if robot == "ant" else model.qpos0
    np.testing.assert_array_equal(robots.qpos, [rest] * 3)
    assert not robots.qvel.any() and not robots.time.any()
    robots.reset(np.array([1]), rng)
    data.qpos[:], data.qvel[:] = robots.qpos[1], robots.qvel[1]
    for _ in range(20):
        action, before = rng.uniform(-1, 1, (3, ours.nu)).astype(np.float32), data.qpos.copy()
        displacement, unstable = robots.step(action)
        data.ctrl[:] = action[1]
        mujoco.mj_step(model, data, 5)  # frame_skip
        assert not unstable.any()
        np.testing.assert_allclose(displacement[1], (data.qpos - before)[:robots.places], atol=1e-6)
    np.testing.assert_allclose(robots.qpos[1], data.qpos, atol=1e-8)
    np.testing.assert_allclose(robots.observe()[1], np.r_[data.qpos[robots.places:], data.qvel], atol=1e-4, rtol=1e-5)
    assert robots.time.tolist() == pytest.approx([1.0] * 3)


def test_robots_equal_a_plain_loop_over_mj_step():
    robots, model, rng = common.Robots(robot_spec("ant"), 4, 2), robot_spec("ant").compile(), np.random.default_rng(0)
    robots.reset(np.arange(4), rng)
    data = [mujoco.MjData(model) for _ in range(4)]
    for one, qpos, qvel in zip(data, robots.qpos, robots.qvel):
        one.qpos[:], one.qvel[:] = qpos, qvel
    for _ in range(20):
        action = rng.uniform(-1, 1, (4, 8))
        robots.step(action)
        for one, a in zip(data, action):
            one.ctrl[:] = a
            mujoco.mj_step(model, one, common.FRAME_SKIP)
    np.testing.assert_allclose(robots.qpos, [one.qpos for one in data], atol=1e-12)


def test_an_unstable_simulation_is_noticed_and_the_others_go_on(s3):
    robots = common.Robots(robot_spec("ant"), 3, 1)
    robots.step(np.zeros((3, 8)))
    robots.qvel[1] = 1e12
    displacement, unstable = robots.step(np.zeros((3, 8)))
    assert unstable.tolist() == [False, True, False] and torch.isfinite(displacement[[0, 2]]).all()
    assert robots.time.tolist() == pytest.approx([0.1, 0.05, 0.1])  # MuJoCo has reset it
    assert robots.step(np.zeros((3, 8)))[1].tolist() == [False, True, False]  # until we reset it
    robots.reset(np.flatnonzero(unstable))
    assert not robots.step(np.zeros((3, 8)))[1].any()


# ---------------------------------------------------------------- actor and base frame

def product(a, b):
    """Of two quaternions."""
    return np.r_[a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])]


@pytest.mark.parametrize("yaw", [0.7, -2.0, math.pi, 6.0])
def test_turning_the_world_changes_neither_inputs_nor_actions(yaw):
    """A world and the same one turned, simulated side by side for ten steps of the policy."""
    torch.manual_seed(0)
    robots, rng = common.Robots(robot_spec("ant"), 2, 1), np.random.default_rng(0)
    robots.reset(np.arange(2), rng)
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    q, v = robots.qpos, robots.qvel
    q[0, 3:7] = (0.7, 0.3, -0.2, 0.6) / np.linalg.norm((0.7, 0.3, -0.2, 0.6))
    q[1], v[1] = q[0], v[0]
    q[1, :2], v[1, :2] = turn @ q[0, :2], turn @ v[0, :2]
    q[1, 3:7] = -product(np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]), q[0, 3:7])  # -q is the same turn as q
    command = np.array([0.3, 0.5])
    c = torch.tensor(np.stack([command, turn @ command]), dtype=torch.float32)
    actor = common.Actor(27, 2, 8, 16, True)
    for _ in range(10):
        x, action = actor.inputs(robots.observe(), c), actor.act(robots.observe(), c, True)
        torch.testing.assert_close(x[0], x[1], atol=1e-3, rtol=0)
        torch.testing.assert_close(action[0], action[1], atol=1e-3, rtol=0)
        displacement, _ = robots.step(action[:1].expand(2, -1).numpy())
        np.testing.assert_allclose(displacement[1], turn @ displacement[0].numpy(), atol=1e-4)
    assert (actor.act(robots.observe(), c[[0, 0]], True).diff(dim=0).abs() > 1e-4).any()  # the command does count


def test_log_probability_is_that_of_a_transformed_distribution():
    torch.manual_seed(0)
    actor = common.Actor(5, 2, 3, 32, False)
    x = actor.inputs(torch.randn(200, 5), torch.randn(200, 2))
    action, log_prob = actor(x)
    mean, log_std = actor.net(x).chunk(2, 1)
    oracle = D.TransformedDistribution(D.Normal(mean, log_std.clamp(-5, 2).exp()), D.TanhTransform(cache_size=1))
    inside = (action.abs() < 0.999).all(1)  # where tanh can be inverted in float32
    assert inside.sum() > 100
    torch.testing.assert_close(log_prob[inside], oracle.log_prob(action).sum(1)[inside], atol=2e-3, rtol=1e-3)
    torch.testing.assert_close(actor(x, deterministic=True)[0], torch.tanh(mean))


# ---------------------------------------------------------------- reward and SAC

def test_reward_is_equation_6_up_to_its_maximum(s3):
    torch.manual_seed(0)
    mean, log_var, displacement = torch.randn(40, 2), torch.randn(40, 2), 0.1 * torch.randn(40, 2)
    for floor, std in ((0.0, (log_var / 2).exp() / 10), (10.0, torch.full((40, 2), 10.0))):  # none; above all deviations
        p = D.Independent(D.Normal(mean / 10, std), 1)
        expected = s3.REWARD_SCALE * (p.log_prob(displacement) - p.log_prob(mean / 10))
        torch.testing.assert_close(s3.reward(mean, log_var, displacement, floor), expected, **CLOSE)


def small_sac(s3, every):
    torch.manual_seed(0)
    vars(s3).update(HIDDEN=32, TEMPERATURE=0.05, BASE_FRAME=False, ACTOR_EVERY=every, DISCOUNT=0.9)
    sac = s3.Sac(5, 2, 3)
    for one in (sac.target, sac.average):
        for p in one.parameters():
            p.add_(0.1 * torch.randn_like(p))  # unlike the networks that they follow
    batch = torch.randn(64, 7), torch.rand(64, 3) * 2 - 1, torch.randn(64, 7), torch.randn(64)
    return sac, batch


def test_one_update_of_sac_equals_a_plain_version(s3):
    """Adam is replaced by a plain step down the gradient, and the two losses of one backward by one at a time."""
    sac, (x, a, x2, r) = small_sac(s3, 1)
    sac.critic_adam = torch.optim.SGD(sac.critics.parameters(), lr=1.0)
    sac.actor_adam = torch.optim.SGD([*sac.actor.parameters(), *sac.value.parameters()], lr=1.0)
    plain, actor, value, target, average = map(s3.copy.deepcopy, (sac.critics, sac.actor, sac.value, sac.target, sac.average))
    torch.manual_seed(1)
    sac.update(x, a, x2, r)

    def q(net, action):
        return net(torch.cat([x, action], 1)).squeeze(1)

    def descend(loss, *networks):
        parameters = [p for net in networks for p in net.parameters()]
        for p, slope in zip(parameters, torch.autograd.grad(loss, parameters)):
            p.data -= slope

    goal = (r + 0.9 * target(x2).squeeze(1)).detach()
    assert sac.losses["q"] == pytest.approx(q(plain[0], a).mean().item(), abs=1e-6)
    descend(sum(0.5 * (q(net, a) - goal).square().mean() for net in plain), *plain)
    torch.manual_seed(1)
    a_new, log_prob = actor(x)
    smaller = torch.min(q(plain[0], a_new), q(plain[1], a_new))
    v_goal = (smaller - 0.05 * log_prob).detach()
    descend((0.05 * log_prob - smaller).mean(), actor)
    descend(0.5 * (value(x).squeeze(1) - v_goal).square().mean(), value)
    for ours, theirs in ((sac.critics, plain), (sac.actor, actor), (sac.value, value)):
        for p, wanted in zip(ours.parameters(), theirs.parameters()):
            torch.testing.assert_close(p, wanted, **CLOSE)
    for followed, before, ours, rate in ((sac.average, average, actor, s3.AVERAGED), (sac.target, target, value, s3.SMOOTHING)):
        for after, old, wanted in zip(*(net.parameters() for net in (followed, before, ours))):
            torch.testing.assert_close(after, (1 - rate) * old + rate * wanted, **CLOSE)


def test_without_an_average_the_policy_is_the_actor(s3):
    sac, batch = small_sac(s3, 1)
    s3.AVERAGED = 0.0  # off
    sac.update(*batch)
    assert all(torch.equal(p, q) for p, q in zip(sac.average.parameters(), sac.actor.parameters()))


def test_the_actor_waits_for_every_second_update_of_the_critics(s3):
    sac, (x, a, x2, r) = small_sac(s3, 2)
    waiting = [sac.actor, sac.value, sac.target, sac.average]

    def changed(networks):
        before = [p.clone() for net in networks for p in net.parameters()]
        sac.update(x, a, x2, r)
        return [not torch.equal(p, q) for p, q in zip(before, [p for net in networks for p in net.parameters()])]
    assert all(changed([sac.critics])) and sac.updates == 1
    assert all(changed(waiting)) and not any(changed(waiting))


def test_learn_takes_batches_and_its_rate_falls_in_the_second_half(s3, monkeypatch):
    sac, _ = small_sac(s3, 1)
    vars(s3).update(UPDATES=1000, BATCH=24)
    taken, batch = [], SimpleNamespace(s=torch.randn(72, 5), a=torch.randn(72, 3), s2=torch.randn(72, 5))
    c, r = torch.randn(72, 2), torch.randn(72)
    monkeypatch.setattr(sac, "update", lambda *part: taken.append(part))
    for progress, rate in ((0, 1), (0.25, 1), (0.5, 1), (0.75, 0.5), (1, 0)):
        sac.updates = int(1000 * progress)
        sac.learn(batch, c, r)
        for optimizer in (sac.critic_adam, sac.actor_adam):
            assert optimizer.param_groups[0]["lr"] == pytest.approx(rate * s3.LEARNING_RATE)
    assert [len(part[0]) for part in taken] == [24] * 15
    wanted = sac.actor.inputs(batch.s, c), batch.a, sac.actor.inputs(batch.s2, c), r  # the same command after the step
    assert all(map(torch.equal, map(torch.cat, zip(*taken[:3])), wanted))


# ---------------------------------------------------------------- the loop of Alg. 1

THREE = ["speed", "direction", "curvature"]


def test_one_pass_of_alg_1_pays_equation_6(s3, monkeypatch):
    """Stored steps, a share of them relabelled, judged by torch.distributions; the commands before and after."""
    torch.manual_seed(0)
    vars(s3).update(ROBOTS=4, SKILL_STEPS=5, EPISODE=10, REPLAY=400, WARM_UP=10, UPDATES=8, HIDDEN=16, BATCH=600,
                    UPDATES_PER_STEP=2, RELABELLED=0.4, FLOOR_START=0.05, THREADS=1)
    decoder = common.Decoder(3, 2, 16).requires_grad_(False)
    decoder.head[2].weight *= 5

    def fill(replay):
        replay.added = 300
        replay.table[:300] = torch.randn(300, replay.table.shape[1])
        replay.read(slice(0, 300)).displacement.mul_(0.05)
    done = one_pass(s3, monkeypatch, lambda: s3.train_wedis(decoder, THREE), fill)
    stored, batch, n = done.stored, done.batch, 1200
    rows = (batch.s[:, None, 0] == stored.s[:, 0]).int().argmax(1)  # which of the stored steps these are
    for name in ("s", "a", "s2", "displacement"):
        assert torch.equal(vars(batch)[name], vars(stored)[name][rows])
    own = (batch.z_single == stored.z_single[rows]).all(1)
    assert own.float().mean().item() == pytest.approx(0.6, abs=0.05)
    assert batch.z_single[~own].std(0).tolist() == pytest.approx([1, 1], abs=0.15)
    mean, log_var = (part[:, 0] for part in decoder(torch.cat([batch.z_single, torch.zeros(n, 1)], 1), 1))
    assert torch.allclose(done.c, mean)
    std = ((log_var / 2).exp() / 10).clamp(min=0.05)
    p = D.Independent(D.Normal(0.1 * done.c, std), 1)
    expected = s3.REWARD_SCALE * (p.log_prob(batch.displacement) - p.log_prob(0.1 * done.c))
    torch.testing.assert_close(done.r, expected, atol=1e-4, rtol=1e-3)
    assert done.log.numbers["reward"] == pytest.approx(expected.mean().item(), rel=1e-3)


@pytest.mark.parametrize("progress, decay_from, start, end, floor", [
    (0, 0.5, 0.08, 0.02, 0.08), (0.25, 0.5, 0.08, 0.02, 0.04), (0.5, 0.5, 0.08, 0.02, 0.02), (0.9, 0.5, 0.08, 0.02, 0.02),
    (0.5, 1, 0.08, 0.02, 0.04), (0.5, 0, 0.08, 0.02, 0.02), (0.3, 0.5, 0, 0, 0), (0.3, 0.5, 0.08, 0, 0), (0.9, 0.5, 0, 0.02, 0.02)])
def test_the_floor_of_the_reward_shrinks_geometrically_and_may_be_off(progress, decay_from, start, end, floor, s3, monkeypatch):
    torch.manual_seed(0)
    vars(s3).update(ROBOTS=4, SKILL_STEPS=5, EPISODE=10, REPLAY=400, WARM_UP=10, UPDATES=1000, HIDDEN=16, BATCH=50,
                    FLOOR_START=start, FLOOR_END=end, DECAY_FROM=decay_from, THREADS=1)
    decoder = common.Decoder(3, 2, 16).requires_grad_(False)
    decoder.head[2].bias[2:] = -6  # a deviation of 5 mm

    def fill(replay):
        replay.added = 300
        replay.table[:300] = 0.05 * torch.randn(300, replay.table.shape[1])
    done = one_pass(s3, monkeypatch, lambda: s3.train_wedis(decoder, THREE), fill,
                    lambda log: setattr(log.sac, "updates", int(1000 * progress)))
    _, log_var = decoder(torch.cat([done.batch.z_single, torch.zeros(400, 1)], 1), 1)
    p = D.Independent(D.Normal(0.1 * done.c, ((log_var[:, 0] / 2).exp() / 10).clamp(min=floor)), 1)
    expected = s3.REWARD_SCALE * (p.log_prob(done.batch.displacement) - p.log_prob(0.1 * done.c))
    torch.testing.assert_close(done.r, expected, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("names, x_dim", [(THREE, 2), (["speed", "acceleration"], 1)])
def test_robots_are_asked_for_single_steps(names, x_dim, s3, monkeypatch):
    """The commands of 300 robots against the decoder's first means for (z_single, 0), at the first step and later."""
    torch.manual_seed(0)
    vars(s3).update(ROBOTS=300, SKILL_STEPS=5, EPISODE=10, WARM_UP=10 ** 6, REPLAY=4500, HIDDEN=8, THREADS=1)
    if x_dim == 1:
        vars(s3).update(ROBOT="half_cheetah", BASE_FRAME=False)
    decoder, asked = common.Decoder(len(names), x_dim, 16).requires_grad_(False), []
    act = common.Actor.act
    monkeypatch.setattr(common.Actor, "act", lambda actor, s, c: asked.append(c) or act(actor, s, c))
    done = one_pass(s3, monkeypatch, lambda: s3.train_wedis(decoder, names), passes=12)
    stored = done.log.replay.read(torch.arange(12 * 300).view(12, 300))
    assert stored.z_single.shape == (12, 300, x_dim)
    for t, c in enumerate(asked):
        mean = decoder(nn.functional.pad(stored.z_single[t], (0, len(names) - x_dim)), 1)[0][:, 0]
        torch.testing.assert_close(c, mean)
    assert stored.z_single[-1].std(0).tolist() == pytest.approx([1] * x_dim, abs=0.12)  # z_single from the prior
    renewed = (stored.z_single[1:] != stored.z_single[:-1]).any(2)  # each robot at a time of its own, every fifth step
    assert renewed[:5].sum(0).eq(1).all() and renewed[5:10].sum(0).eq(1).all()
    assert 0.1 < renewed[5].float().mean() < 0.3


def steps_of(s3, monkeypatch, n, **changed):
    """Replay buffer and robots of 8 robots after n steps with random actions."""
    torch.manual_seed(0)
    vars(s3).update(dict(ROBOTS=8, SKILL_STEPS=4, EPISODE=12, REPLAY=128, WARM_UP=10 ** 6, HIDDEN=8, THREADS=1) | changed)
    done = one_pass(s3, monkeypatch, lambda: s3.train_wedis(common.Decoder(3, 2, 8).requires_grad_(False), THREE), passes=n)
    return done.log.replay, done.log.robots


@pytest.mark.parametrize("n, added", [(3, 24), (37, 296)])
def test_stored_steps_go_on_where_the_last_one_ended(s3, monkeypatch, n, added):
    replay, robots = steps_of(s3, monkeypatch, n)
    assert replay.added == added and len(replay.table) == 128
    kept = min(n, 16)
    rows = replay.read((torch.arange(kept * 8) + (n - kept) * 8) % 128)
    s, s2 = rows.s.view(kept, 8, 27), rows.s2.view(kept, 8, 27)
    goes_on = (s[1:] == s2[:-1]).all(2)
    assert goes_on.float().mean() > 0.85 - (n == 3) and not goes_on.all()  # each robot starts anew every 12 steps
    velocity = (rows.s[:, 13:15] + rows.s2[:, 13:15]) / 2
    torch.testing.assert_close(rows.displacement / 0.05, velocity, atol=1.5, rtol=0)  # metres in 0.05 s
    assert robots.age().max() < 12 and torch.equal(robots.observe()[robots.age()[:, 0] > 0],
                                                   replay.latest(8).s2[robots.age()[:, 0] > 0])


def test_an_unstable_step_is_not_stored_and_the_robot_starts_anew(s3, monkeypatch):
    step, count = common.Robots.step, iter(range(99))

    def fail(robots, action):
        displacement, unstable = step(robots, action)
        if next(count) == 3:
            displacement[5], unstable[5] = math.nan, True
        return displacement, unstable
    monkeypatch.setattr(common.Robots, "step", fail)
    replay, robots = steps_of(s3, monkeypatch, 4, EPISODE=1000)
    last, before = replay.table[24:32], replay.table[16:24]
    assert torch.equal(last[5], before[5]) and not torch.equal(last[4], before[4])
    assert robots.time[5] == 0 and (np.delete(robots.time, 5) > 0).all()
    assert torch.isfinite(replay.table).all()


@pytest.mark.parametrize("n", [3, 16, 37])
def test_the_replay_buffer_gives_the_latest_steps(s3, n):
    vars(s3).update(ROBOTS=8, SKILL_STEPS=4, REPLAY=128)
    replay = s3.Replay(s=2, when=1)
    assert not replay.latest(8).when.any()  # at the start zeros
    for t in range(1, n + 1):
        replay.add(torch.zeros(8, dtype=torch.bool).numpy(), when=torch.full((8, 1), float(t)), s=torch.rand(8, 2))
    batch = replay.sample(2000)
    assert set(batch.when[:, 0].int().tolist()) == set(range(max(1, n - 15), n + 1)) and batch.s.shape == (2000, 2)
    assert replay.latest(8).when.unique().tolist() == [n]
    assert replay.latest(24).when[:, 0].tolist() == [n - 2] * 8 + [n - 1] * 8 + [n] * 8
    assert len(replay.latest(10 ** 9).when) == min(8 * n, 128)


def test_the_smallest_replay_buffer_holds_two_skills_of_all_robots(s3):
    vars(s3).update(ROBOTS=8, SKILL_STEPS=4, REPLAY=1)
    assert len(s3.Replay(s=2).table) == 2 * 8 * 4


# ---------------------------------------------------------------- checkpoints

def outcome(out, experiment):
    """Policy and checkpoint without clocks and flags."""
    found = [common.load(out, kind, experiment, 0) for kind in ("policy", "policy-checkpoint")]
    return [{key: value for key, value in content.items() if key not in ("seconds", "config", "sha256")}
            for content in found]


def same(one, other):
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one if k != "minutes")
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, nn.Module):
        return same(one.state_dict(), other.state_dict())
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


@pytest.mark.parametrize("experiment", ["ant_semi", "ant_dads", "ant_sectar", "half_cheetah"])
def test_resumed_and_two_threads_give_the_same_bits(experiment, out, inside, monkeypatch, s3):
    monkeypatch.setattr(s3, "measure", lambda *_: None)
    monkeypatch.setattr(s3, "draw_skills", lambda *_: None)
    tiny_run = dict(experiment=experiment, updates=48)
    step, ends = s3.Log.step, []

    def cut(log):
        step(log)
        if log.sac.updates == 24:  # the first report, and with it a checkpoint
            raise SystemExit("cut")
    for threads in (1, 2):
        assert inside(s3, *tiny(out, **tiny_run, threads=threads)).returncode == 0
        ends.append(outcome(out, experiment))
    (out / f"policy_{experiment}_seed0.pt").unlink()
    monkeypatch.setattr(s3.Log, "step", cut)
    assert inside(s3, *tiny(out, **tiny_run)).returncode == "cut"
    monkeypatch.setattr(s3.Log, "step", step)
    for _ in range(2):  # the second time nothing is left to be trained
        assert inside(s3, *tiny(out, **tiny_run), "--resume", "true").returncode == 0
        assert same(ends[0], ends[1]) and same(ends[0], outcome(out, experiment))
        assert load_policy(out, experiment, 0).updates == 48


# ---------------------------------------------------------------- relation functions and execution

def test_relation_functions_are_the_papers():
    z = torch.tensor([[0.5, 0.2, 1.0], [-0.5, 0.0, 1.0]])
    found = common.next_skill(z, ["speed", "direction", "curvature"], dict(curvature=-0.2))  # Sec. 6.1.2
    torch.testing.assert_close(found, torch.tensor([[0.5, 0.0, 1.0], [-0.5, -0.2, 1.0]]))
    found = common.next_skill(z[:, [0, 2]], ["speed", "acceleration"], dict(acceleration=-0.1))  # A.3.2
    torch.testing.assert_close(found, torch.tensor([[0.4, 1.0], [-0.4, 1.0]]))
    found = common.next_skill(z, ["speed", "direction", "acceleration"], dict(acceleration=0.1))  # Sec. 4.2.2
    torch.testing.assert_close(found, torch.tensor([[0.6, 0.2, 1.0], [-0.4, 0.0, 1.0]]))


class Turning(nn.Module):
    """A decoder whose skills turn by exactly `weight` of z_curvature a transition."""
    x_dim, axes = 2, torch.eye(3)

    def __init__(self, weight):
        super().__init__()
        self.weight = weight

    def forward(self, z, steps):
        angle = z[:, 1:2] + self.weight * z[:, 2:3] * torch.arange(steps)
        return (0.5 + 0.2 * z[:, :1, None]) * torch.stack([angle.cos(), angle.sin()], 2), torch.zeros(len(z), steps, 2)


@pytest.mark.parametrize("weight", [0.155, -0.31])
def test_calibration_finds_the_weight_of_a_decoder_that_turns_exactly(s2, weight):
    found = s2.find_relation(Turning(weight), THREE, 5, 1.5)
    assert found == dict(curvature=pytest.approx(weight))


def test_commands_are_the_decoders_first_steps():
    torch.manual_seed(0)
    decoder, z = common.Decoder(3, 2, 16), torch.randn(6, 3)
    policy = SimpleNamespace(decoder=decoder, names=["speed", "direction", "curvature"], relation=dict(curvature=0.3),
                             method="wedis")
    found = common.commands_of(policy, z, 4)
    for t in range(4):
        single = torch.stack([z[:, 0], z[:, 1] + t * 0.3 * z[:, 2], torch.zeros(6)], 1)
        torch.testing.assert_close(found[:, t], decoder(single, 1)[0][:, 0])
    policy.names, policy.method = [], "sectar"
    torch.testing.assert_close(common.commands_of(policy, z, 4), decoder(z, 4)[0])
    policy.method = "dads"
    torch.testing.assert_close(common.commands_of(policy, z, 4), z[:, None].expand(-1, 4, -1))


class Fake:
    """Robots that make `share` of the step that they are asked for, and keep what that was."""
    places = 2

    def __init__(self, n=1, share=0.9):
        self.qpos, self.share, self.asked = np.zeros((n, 15)), share, []
        self.broken = np.zeros(n, bool)

    def place(self):
        return torch.from_numpy(self.qpos[:, :2]).float()

    def observe(self):
        return torch.zeros(len(self.qpos), 3)

    def reset(self, ids, rng=None):
        self.qpos[ids, :2] = 0

    def step(self, action):
        self.asked.append(torch.from_numpy(action))
        self.qpos[:, :2] += 0.1 * self.share * action
        return 0.1 * self.share * self.asked[-1], self.broken


OBEY = SimpleNamespace(act=lambda s, c, deterministic: c.clone())  # an actor whose action is its command


@pytest.fixture
def numbers(monkeypatch):
    """The numbers of the closed loop that the tests below count with."""
    for name, value in dict(FEEDBACK=0.1, CORRECTION=0.2).items():
        monkeypatch.setattr(common, name, value)


@pytest.mark.parametrize("c, reference, expected", [
    ((0.3, 0.0), (0.1, 0.0), (0.4, 0.0)),   # FEEDBACK 0.1 of one trajectory unit
    ((0.0, 0.0), (0.15, 0.0), (0.15, 0.0)),
    ((2.5, 0.0), (0.0, 0.1), (2.5, 0.1)),
    ((0.8, 0.0), (0.02, 0.0), (0.82, 0.0)),
    ((0.3, 0.0), (0.0, 5.0), (0.3, 0.2)),   # CORRECTION: at most 0.2
    ((3.0, 4.0), (0.0, 0.0), (3.0, 4.0))])  # where it should be, nothing changes
def test_closed_loop_by_hand(c, reference, expected, numbers):
    found = common.closed_loop(torch.tensor([c]), torch.tensor([reference]), Fake(), 0.1)
    torch.testing.assert_close(found, torch.tensor([expected]))


def test_execute_holds_commands_open_and_closed(numbers):
    commands = torch.tensor([[[0.5, 0.0], [0.0, 2.0]]])
    policy, robots = SimpleNamespace(actor=OBEY, scale=0.1), Fake()
    poses = common.execute(policy, robots, commands, 3, False, True)
    assert poses.shape == (6, 1, 15) and poses[:, 0, :2] == pytest.approx(
        0.09 * np.cumsum(np.repeat([[0.5, 0], [0, 2]], 3, 0), 0), abs=1e-6)
    torch.testing.assert_close(torch.cat(robots.asked), commands[0].repeat_interleave(3, 0))  # open loop: unchanged
    still = Fake(share=0.0)
    common.execute(policy, still, commands[:, :1], 3, True, True)
    torch.testing.assert_close(torch.cat(still.asked)[:, 0], torch.tensor([0.5, 0.55, 0.6]))  # 0.5 behind a step


OFF = [dict(), dict(CORRECTION=0.0), dict(FEEDBACK=0.0), dict(CORRECTION=0.0, FEEDBACK=0.0)]


@pytest.mark.parametrize("changed", OFF, ids=[" ".join(change) or "nothing" for change in OFF])
def test_what_is_switched_off_is_off_and_commands_keep_their_direction(changed, numbers, monkeypatch):
    """Commands of all sizes, 0 and huge ones among them, against a closed form of one command at a time."""
    for name, value in changed.items():
        monkeypatch.setattr(common, name, value)
    rng = np.random.default_rng(0)
    c = np.r_[np.zeros((4, 2)), rng.normal(0, 1, (200, 2)) * rng.choice([1e-6, 0.1, 1, 30], (200, 1))]
    behind = rng.normal(0, 1, (204, 2)) * rng.choice([0, 1e-4, 0.1, 50], (204, 1))  # metres
    behind[:2] = 0
    found = common.closed_loop(torch.tensor(c).float(), torch.tensor(behind).float(), Fake(204), 0.1).numpy()
    for one, gap, ours in zip(c, behind, found):
        gain = common.FEEDBACK * gap / 0.1
        if common.CORRECTION and np.hypot(*gain) > common.CORRECTION:
            gain *= common.CORRECTION / np.hypot(*gain)
        if not common.CORRECTION:  # off
            gain *= 0
        assert np.isfinite(ours).all() and ours == pytest.approx(one + gain, abs=1e-5)


def test_age_counts_environment_steps_whatever_a_step_is(monkeypatch):
    monkeypatch.setattr(common, "FRAME_SKIP", 11)
    robots = common.Robots(robot_spec("ant"), 1)
    for n in range(3):
        assert robots.age().item() == n
        robots.step(np.zeros((1, 8)))
    assert robots.step_seconds == pytest.approx(0.11)


def test_unstable_simulations_are_said_aloud(numbers, capsys):
    policy, robots = SimpleNamespace(actor=OBEY, scale=0.1), Fake(3)
    common.execute(policy, robots, torch.rand(3, 2, 2), 2, True, True)
    assert capsys.readouterr().out == ""
    robots.broken[1] = True
    common.execute(policy, robots, torch.rand(3, 2, 2), 2, False, True)
    printed = capsys.readouterr().out
    assert printed.startswith("1 of 3 simulations were unstable") and printed.count("\n") == 1
    assert common.execute(policy, robots, torch.rand(3, 2, 2)[:, :0], 2, True, True).shape == (0, 3, 15)


# ---------------------------------------------------------------- measures

def test_tracking_and_following_by_hand(s3, monkeypatch):
    """Robots that make 9/10 of each step end a tenth short; of three skills one after another, each anew."""
    def robots(spec, n, threads):
        made = Fake(n)
        made.qpos[0, 4] = 1.0  # the first one lies on its back
        return made
    monkeypatch.setattr(common, "Robots", robots)
    vars(s3).update(STARTS=10, SINGLE_RUN=(1, 7), MULTI_RUN=(3, 4))
    names = ["speed", "direction", "curvature"]
    policy = SimpleNamespace(actor=OBEY, decoder=Turning(0.2), names=names, relation=dict(curvature=0.2), scale=0.1,
                             method="wedis")
    assert s3.tracking(policy, False) == pytest.approx(0.1, abs=1e-5) and s3.tracking(policy, True) < 0.1
    policy.decoder, policy.relation = Turning(0.0), dict(curvature=0.0)
    found = s3.following(policy, False)
    # 12 steps of 0.1 x (0.5 + 0.2 z_speed), z_speed ~ U(0, 1.5); a tenth of them is missing
    assert 0.1 * 1.2 * 0.5 < found["follow_median_m"] < found["follow_p90_m"] < 0.1 * 1.2 * 0.8
    assert found["fall_rate"] == pytest.approx(0.1) and found["follow_decoder_m"] == found["follow_median_m"]
    assert 0.09 * 0.5 < found["speed_m_per_step"] < 0.09 * 0.8
    policy.decoder, policy.relation = Turning(0.2), dict(curvature=0.2)
    C, purity = s3.executed_cross_talk(policy, dict(speed=(0.0, 1.0), direction=(-1.5, 1.5), curvature=(-0.3, 0.3)), False)
    assert C[0] == pytest.approx([0.9 * 0.6, 0, 0], abs=1e-4) and C[1] == pytest.approx([0, 1, 0], abs=1e-4)
    assert purity[:2] == pytest.approx([1, 1], abs=1e-3)


@pytest.mark.parametrize("robot, poses", [
    ("ant", [[0.6, 1, 0, 0, 0], [0.6, 0.8, 0.6, 0, 0], [0.6, 0.6, 0.8, 0, 0], [0.2, 0, 0, 1, 0], [0.6, 0, 0, 0, 1]]),  # w, x, y, z
    ("half_cheetah", [[0.0, 0.0], [0.0, 1.5], [0.0, 1.7], [0.0, -3.1], [0.0, 6.3]])])  # height, pitch
def test_a_robot_falls_if_its_torso_points_down(robot, poses, s3, monkeypatch):
    vars(s3).update(ROBOT=robot, STARTS=5, MULTI_RUN=(1, 4))
    monkeypatch.setattr(common, "Robots", lambda spec, n, threads: Fake(n))
    bodies = np.zeros((4, 5, 15))
    at = dict(ant=2, half_cheetah=1)[robot]  # behind the place
    bodies[2, :, at:at + len(poses[0])] = poses  # at one moment of four: whoever ever turns over has fallen
    bodies[[0, 1, 3], :, 3] = robot == "ant"
    monkeypatch.setattr(s3, "execute", lambda *_: bodies)
    policy = SimpleNamespace(decoder=Turning(0.0), names=["speed", "direction", "curvature"], relation=dict(curvature=0.0),
                             scale=0.1, method="wedis")
    assert s3.following(policy, True)["fall_rate"] == pytest.approx(2 / 5)


# ---------------------------------------------------------------- from training to figures

@pytest.mark.parametrize("experiment", ROWS)
def test_each_row_of_experiments_from_training_to_figures(experiment, s3, fork, out):
    done = fork(S3, *tiny(out, experiment=experiment))
    assert done.returncode == 0, done.stderr
    row, = common.read_csv(out / "results/policies.csv")
    assert row["experiment"] == experiment and int(row["updates"]) == 24 and float(row["tracking_error"]) > 0
    last = load_policy(out, experiment, 0).curve[-1]
    assert last["tracking_error"] == pytest.approx(float(row["tracking_error"]), rel=1e-4)
    wedis = row["method"] == "wedis"
    assert ("tracking_error_closed" in row) == ("fall_rate" in row) == wedis
    figure = s3.EXPERIMENTS[experiment].get("FIGURE", f"skills_{experiment}")
    assert (out / f"figures/{figure}.png").stat().st_size > 5_000


def test_a_row_of_ones_own_and_measuring_flags(s3, inside, out):
    """A new row trains and is measured; flags that only measure are no obstacle to --resume, others are one line."""
    s3.EXPERIMENTS["mine"] = dict(TEMPERATURE=0.01, ROBOTS=4)
    flags = [text for text in tiny(out, experiment="mine") if text not in ("--robots", "8")]
    assert inside(s3, *flags).returncode == 0
    policy = load_policy(out, "mine", 0)
    assert policy.config["TEMPERATURE"] == 0.01 and policy.config["ROBOTS"] == 4
    more = "--resume true --starts 2 --z_range 1 --traversal 5 --noisy 1 --figure x".split()
    for extra in (more, [*more, "--train", "false"]):
        assert inside(s3, *flags, *extra).returncode == 0
    done = inside(s3, *flags, "--resume", "true", "--hidden", 24)
    assert one_line(done, 2) and "HIDDEN = 16, not 24" in done.stderr
    done = inside(s3, *flags, "--train", "false", "--step_scale", 0.2)
    assert one_line(done, 2) and "STEP_SCALE = 0.1, not 0.2" in done.stderr


@pytest.mark.parametrize("what", ["FRAME_SKIP", "CORRECTION", "ant.xml", "half_cheetah.xml", "FEEDBACK", "CLASSES"])
def test_another_physics_is_another_policy(what, s3, inside, out, tree, monkeypatch):
    """What a training saw must be the same to resume it and to measure it; what only a measurement sees is in its row."""
    assert inside(s3, *tiny(out)).returncode == 0
    if what.endswith("xml"):
        file = tree / "robots" / what
        text = file.read_text()
        assert 'timestep="0.01"' in text
        file.write_text(text.replace('timestep="0.01"', 'timestep="0.008"'))
    else:
        monkeypatch.setattr(common, what, dict(FRAME_SKIP=4, CORRECTION=0.3, FEEDBACK=0.3, CLASSES=common.CLASSES | dict(x=9))[what])
    measured = {row["settings"] for row in common.read_csv(out / "results/policies.csv")}
    for flags in (["--train", "false"], ["--resume", "true"]):
        done = inside(s3, *tiny(out), *flags)
        if what in ("FRAME_SKIP", "ant.xml"):
            assert one_line(done, 2) and f"made with {what} = " in done.stderr, done.stderr
        else:
            assert done.returncode == 0, done.stderr
    rows = common.read_csv(out / "results/policies.csv")
    assert len(measured) == 1 and rows[0]["settings"] in measured  # it stays
    if what in ("FEEDBACK", "CORRECTION", "CLASSES"):
        assert rows[1]["settings"] not in measured


def test_a_policy_is_saved_before_it_is_measured(s3, inside, out, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError
    monkeypatch.setattr(s3, "measure", fail)
    with pytest.raises(ZeroDivisionError):
        inside(s3, *tiny(out))
    assert load_policy(out, "ant_semi", 0).updates == 24

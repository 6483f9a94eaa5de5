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
from conftest import S3, load_policy, one_line, robot_spec, script, tiny
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
    robots.qpos[2, 3:7] = 0, 1, 0, 0  # half a turn about x
    assert s3.upside_down(robots).tolist() == [False, False, True]


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
    s3.VARIANCE_SCALE = 1 / 20  # App. A.1.3; without a floor, then with one above all deviations
    for floor, std in ((0.0, (log_var.exp() / 20).sqrt()), (10.0, torch.full((40, 2), 10.0))):
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
    """Adam is replaced by a plain step down the gradient; the plain version has two separate critics."""
    sac, (x, a, x2, r) = small_sac(s3, 1)
    sac.critic_adam = torch.optim.SGD(sac.critics.parameters(), lr=1.0)
    sac.actor_adam = torch.optim.SGD([*sac.actor.parameters(), *sac.value.parameters()], lr=1.0)
    plain = [nn.Sequential(nn.Linear(10, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 1))
             for _ in range(2)]
    for k, net in enumerate(plain):
        for i, layer in enumerate((net[0], net[2], net[4])):
            layer.weight.data = sac.critics.weights[i][k].T.detach().clone()
            layer.bias.data = sac.critics.biases[i][k, 0].detach().clone()
    actor, value = s3.copy.deepcopy(sac.actor), s3.copy.deepcopy(sac.value)
    target, average = s3.copy.deepcopy(sac.target), s3.copy.deepcopy(sac.average)
    torch.manual_seed(1)
    sac.update(x, a, x2, r)

    def q(net, action):
        return net(torch.cat([x, action], 1)).squeeze(1)

    def descend(loss, *networks):
        parameters = [p for net in networks for p in net.parameters()]
        for p, slope in zip(parameters, torch.autograd.grad(loss, parameters)):
            p.data -= slope

    torch.testing.assert_close(s3.Critics(10)(x, a).shape, torch.Size([2, 64]))
    goal = (r + 0.9 * target(x2).squeeze(1)).detach()
    descend(sum(0.5 * (q(net, a) - goal).square().mean() for net in plain), *plain)
    torch.testing.assert_close(sac.critics(x, a), torch.stack([q(net, a) for net in plain]), **CLOSE)
    torch.manual_seed(1)
    a_new, log_prob = actor(x)
    smaller = torch.min(q(plain[0], a_new), q(plain[1], a_new))
    v_goal = (smaller - 0.05 * log_prob).detach()
    descend((0.05 * log_prob - smaller).mean(), actor)
    descend(0.5 * (value(x).squeeze(1) - v_goal).square().mean(), value)
    for ours, theirs, old, rate in ((sac.actor, actor, average, s3.AVERAGED), (sac.value, value, target, s3.SMOOTHING)):
        followed = sac.average if ours is sac.actor else sac.target
        for p, wanted, before, after in zip(*(net.parameters() for net in (ours, theirs, old, followed))):
            torch.testing.assert_close(p, wanted, **CLOSE)
            torch.testing.assert_close(after, (1 - rate) * before + rate * wanted, **CLOSE)


def test_the_actor_waits_for_every_second_update_of_the_critics(s3):
    sac, (x, a, x2, r) = small_sac(s3, 2)
    waiting = [sac.actor, sac.value, sac.target, sac.average]

    def changed(networks):
        before = [p.clone() for net in networks for p in net.parameters()]
        sac.update(x, a, x2, r)
        return [not torch.equal(p, q) for p, q in zip(before, [p for net in networks for p in net.parameters()])]
    assert all(changed([sac.critics])) and sac.updates == 1
    assert all(changed(waiting)) and not any(changed(waiting))


def test_the_learning_rate_falls_in_the_second_half(s3):
    sac, (_, a, _, r) = small_sac(s3, 1)
    s3.UPDATES, run = 1000, SimpleNamespace(sac=sac)
    for progress, rate in ((0, 1), (0.25, 1), (0.5, 1), (0.75, 0.5), (1, 0)):
        sac.updates = int(1000 * progress)
        s3.Run.learn(run, torch.zeros(64, 5), a, torch.zeros(64, 5), torch.zeros(64, 2), torch.zeros(64, 2), r)
        for optimizer in (sac.critic_adam, sac.actor_adam):
            assert optimizer.param_groups[0]["lr"] == pytest.approx(rate * s3.LEARNING_RATE)


# ---------------------------------------------------------------- replay buffer and checkpoints

@pytest.fixture
def run(s3):
    """A Run of 8 robots with a replay buffer of 16 steps each; its stored z counts the steps from 1."""
    torch.manual_seed(0)
    vars(s3).update(ROBOTS=8, SKILL_STEPS=4, EPISODE=12, REPLAY=128, WARM_UP=16, HIDDEN=16, THREADS=1, UPDATES=10 ** 9)
    run = s3.Run(None, [], 2, 2, {})

    def steps(n):
        for _ in range(n):
            run.z = torch.full((8, 2), run.steps + 1.0)
            run.act(torch.zeros(8, 2))
            run.collect()
    run.go = steps
    return run


@pytest.mark.parametrize("n", [3, 16, 37])
def test_sample_gives_stored_steps_of_the_recent_window(run, n):
    run.go(n)
    for recent, oldest in ((None, max(1, n - 15)), (16, max(1, n - 1))):
        s, a, s2, displacement, z = run.sample(2000, recent)
        assert set(z[:, 0].int().tolist()) == set(range(oldest, n + 1))
        assert (s.shape, a.shape, s2.shape, displacement.shape) == ((2000, 27), (2000, 8), (2000, 27), (2000, 2))
        torch.testing.assert_close(displacement / 0.05, s2[:, 13:15], atol=2.0, rtol=0)  # metres in 0.05 s
    rows = run.replay.view(-1, 8, 66)
    s, s2, when = rows[..., :27], rows[..., 35:62], rows[..., -1]
    goes_on = (when[1:] == when[:-1] + 1) & (s[1:] == s2[:-1]).all(2)  # it begins where the last one ended
    assert goes_on.float().mean() > (0.5 if n > 15 else 0)


def test_the_smallest_replay_buffer_holds_two_skills_of_all_robots(run, s3):
    s3.REPLAY = 1
    assert len(s3.Run(None, [], 2, 2, {}).replay) == 2 * 8 * 4


def test_an_unstable_step_is_not_stored_and_the_robot_starts_anew(run):
    run.go(3)
    step = run.robots.step

    def fail(action):
        displacement, unstable = step(action)
        displacement[5], unstable[5] = math.nan, True
        return displacement, unstable
    run.robots.step = fail
    run.go(1)
    last, before = run.replay[24:32], run.replay[16:24]
    assert torch.equal(last[5], before[5]) and not torch.equal(last[4], before[4])
    assert run.robots.time[5] == 0 and (np.delete(run.robots.time, 5) > 0).any()
    assert torch.isfinite(run.replay).all()


def outcome(out, experiment):
    """Policy and checkpoint without clocks and flags."""
    found = [common.load(out, kind, experiment, 0) for kind in ("policy", "policy-checkpoint")]
    found[1]["numbers"] = found[1]["numbers"][:2]  # the last is the clock
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
    flags = ["--experiment", experiment, "--updates", 48]
    collect, ends = s3.Run.collect, []

    def cut(run):
        collect(run)
        if run.sac.updates == 24:  # the first report, and with it a checkpoint
            raise SystemExit("cut")
    for threads in (1, 2):
        assert inside(s3, *tiny(out, threads=threads), *flags).returncode == 0
        ends.append(outcome(out, experiment))
    (out / f"policy_{experiment}_seed0.pt").unlink()
    monkeypatch.setattr(s3.Run, "collect", cut)
    assert inside(s3, *tiny(out), *flags).returncode == "cut"
    monkeypatch.setattr(s3.Run, "collect", collect)
    assert inside(s3, *tiny(out), *flags, "--resume", "true").returncode == 0
    assert same(ends[0], ends[1]) and same(ends[0], outcome(out, experiment))


# ---------------------------------------------------------------- commands of the training

@pytest.mark.parametrize("x_dim", [2, 1])
def test_a_share_of_the_commands_is_corrected_as_the_closed_loop_corrects_them(s3, x_dim):
    """The commands of 4000 robots against the decoder's first means; on a rail z_single is the speed alone."""
    torch.manual_seed(0)
    vars(s3).update(ROBOTS=4000, UPDATES=1, CORRECTED=0.3)
    decoder, asked = common.Decoder(3, x_dim, 16).requires_grad_(False), []
    run = SimpleNamespace(z=torch.zeros(4000, 2 * x_dim), decoder=decoder, sac=SimpleNamespace(updates=0), warm=lambda: False,
                          renew=lambda z: vars(run).update(z=z), act=asked.append,
                          collect=lambda: vars(run.sac).update(updates=1))
    s3.train_wedis(run)
    mean = decoder(nn.functional.pad(run.z[:, :x_dim], (0, 3 - x_dim)), 1)[0][:, 0]
    size = (asked[0] - mean).norm(dim=1)
    assert size.max() <= common.CORRECTION + 1e-6 and size.max() > 0.95 * common.CORRECTION
    assert (size > 1e-6).float().mean().item() == pytest.approx(0.3, abs=0.03)
    assert run.z[:, :x_dim].std(0).tolist() == pytest.approx([1] * x_dim, abs=0.05)  # z_single from the prior


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
    x_dim, axes, circle = 2, torch.eye(3), None

    def __init__(self, weight):
        super().__init__()
        self.weight = weight

    def forward(self, z, steps):
        z = nn.functional.pad(z, (0, 3 - z.shape[1]))
        angle = z[:, 1:2] + self.weight * z[:, 2:3] * torch.arange(steps)
        return (0.5 + 0.2 * z[:, :1, None]) * torch.stack([angle.cos(), angle.sin()], 2), torch.zeros(len(z), steps, 2)


@pytest.mark.parametrize("weight", [0.155, -0.31])
def test_calibration_finds_the_weight_of_a_decoder_that_turns_exactly(s2, weight):
    found = s2.find_relation(Turning(weight), ["speed", "direction", "curvature"], 5)
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

    def __init__(self, n=1, share=0.9, age=1000.0):
        self.at, self.share, self.steps, self.asked = torch.zeros(n, 2), share, age, []

    def place(self):
        return self.at.clone()

    @property
    def time(self):
        return np.full(len(self.at), 0.05 * self.steps)

    def observe(self):
        return torch.zeros(len(self.at), 3)

    def reset(self, ids, rng=None):
        self.at[ids] = 0

    def step(self, action):
        self.asked.append(torch.from_numpy(action))
        self.at, self.steps = self.at + 0.1 * self.share * self.asked[-1], self.steps + 1
        return 0.1 * self.share * self.asked[-1], np.zeros(len(self.at), bool)


OBEY = SimpleNamespace(act=lambda s, c, deterministic: c.clone())  # an actor whose action is its command


@pytest.fixture
def numbers(monkeypatch):
    """The numbers of the closed loop that the tests below count with."""
    for name, value in dict(FEEDBACK=0.1, CORRECTION=0.2, FASTEST=0.85, SOFT_START=40).items():
        monkeypatch.setattr(common, name, value)


@pytest.mark.parametrize("c, reference, age, expected", [
    ((0.3, 0.0), (0.1, 0.0), 1000, (0.47, 0.0)),       # FEEDBACK 0.1, 1.7 times, of one trajectory unit
    ((0.0, 0.0), (0.1, 0.0), 1000, (0.2, 0.0)),        # twice as much if the command is 0
    ((2.5, 0.0), (0.0, 0.1), 1000, (0.849321, 0.033973)),  # never less than FEEDBACK
    ((0.8, 0.0), (0.02, 0.0), 1000, (0.824, 0.0)),
    ((0.3, 0.0), (0.0, 5.0), 1000, (0.3, 0.2)),        # CORRECTION: at most 0.2
    ((3.0, 4.0), (0.0, 0.0), 1000, (0.51, 0.68)),      # FASTEST: 0.85 long
    ((3.0, 4.0), (0.0, 0.0), 0, (0.12, 0.16)),         # soft start: 0.2 long
    ((3.0, 4.0), (0.0, 0.0), 20, (0.315, 0.42)),       # half of it: 0.525 long
    ((0.1, 0.0), (0.0, 0.0), 0, (0.1, 0.0))])          # shorter ones pass
def test_closed_loop_by_hand(c, reference, age, expected, numbers):
    found = common.closed_loop(torch.tensor([c]), torch.tensor([reference]), Fake(age=float(age)), 0.1)
    torch.testing.assert_close(found, torch.tensor([expected]))


def test_execute_holds_commands_open_and_closed(numbers):
    commands = torch.tensor([[[0.5, 0.0], [0.0, 2.0]]])
    policy, robots = SimpleNamespace(actor=OBEY, scale=0.1), Fake()
    assert len(list(common.execute(policy, robots, commands, 3, False, True))) == 6
    torch.testing.assert_close(torch.cat(robots.asked), commands[0].repeat_interleave(3, 0))  # open loop: unchanged
    still = Fake(share=0.0)
    list(common.execute(policy, still, commands[:, :1], 3, True, True))
    torch.testing.assert_close(torch.cat(still.asked)[:, 0], torch.tensor([0.5, 0.575, 0.65]))  # 0.5 behind a step


# ---------------------------------------------------------------- measures

def test_tracking_and_following_by_hand(s3, monkeypatch):
    """Robots that make 9/10 of each step end a tenth short; of three skills one after another, each anew."""
    monkeypatch.setattr(s3, "make_robots", lambda n, threads: Fake(n))
    monkeypatch.setattr(s3, "upside_down", lambda robots: np.arange(len(robots.at)) == 0)
    vars(s3).update(STARTS=10, SINGLE_RUN=(1, 7), MULTI_RUN=(3, 4))
    names = ["speed", "direction", "curvature"]
    policy = SimpleNamespace(actor=OBEY, decoder=Turning(0.2), names=names, relation=dict(curvature=0.2), scale=0.1,
                             method="wedis")
    assert s3.tracking(policy, False) == pytest.approx(0.1, abs=1e-5) and s3.tracking(policy, True) < 0.1
    policy.decoder, policy.relation = Turning(0.0), dict(curvature=0.0)
    found = s3.following(policy, False)
    # 12 steps of 0.1 x (0.5 + 0.2 z_speed), z_speed ~ U(0, 1.5); a tenth of them is missing
    assert 0.1 * 1.2 * 0.5 < found["follow_median_m"] < found["follow_p90_m"] < 0.1 * 1.2 * 0.8
    assert found["fall_rate"] == pytest.approx(0.1)
    policy.decoder, policy.relation = Turning(0.2), dict(curvature=0.2)
    C, purity = s3.executed_cross_talk(policy, dict(speed=(0.0, 1.0), direction=(-1.5, 1.5), curvature=(-0.3, 0.3)), False)
    assert C[0] == pytest.approx([0.9 * 0.6, 0, 0], abs=1e-4) and C[1] == pytest.approx([0, 1, 0], abs=1e-4)
    assert purity[:2] == pytest.approx([1, 1], abs=1e-3)


# ---------------------------------------------------------------- from training to figures

@pytest.mark.parametrize("experiment", ROWS)
def test_each_row_of_experiments_from_training_to_figures(experiment, s3, fork, out):
    done = fork(S3, *tiny(out), "--experiment", experiment)
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


def test_a_policy_is_saved_before_it_is_measured(s3, inside, out, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError
    monkeypatch.setattr(s3, "measure", fail)
    with pytest.raises(ZeroDivisionError):
        inside(s3, *tiny(out))
    assert load_policy(out, "ant_semi", 0).updates == 24

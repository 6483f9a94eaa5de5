"""Stage 3: the Ant against Gymnasium's model file, Batch against mj_step, SAC against a plain version."""
import importlib.util
import math
from pathlib import Path

import common
import mujoco
import numpy as np
import pytest
import torch
from torch import distributions as D
from torch import nn


def gymnasiums(robot):
    folder = Path(importlib.util.find_spec("gymnasium").origin).parent
    return mujoco.MjModel.from_xml_path(str(folder / f"envs/mujoco/assets/{robot}.xml"))


@pytest.fixture(scope="module")
def gymnasium_ant():
    return gymnasiums("ant")


# ---------------------------------------------------------------- the robot

FIELDS = """nq nv nu nbody njnt ngeom qpos0 body_parentid body_pos body_quat body_mass body_inertia body_ipos body_iquat
jnt_type jnt_axis jnt_pos jnt_range jnt_limited jnt_stiffness jnt_solref jnt_solimp jnt_margin dof_armature dof_damping dof_frictionloss
geom_type geom_size geom_pos geom_quat geom_friction geom_condim geom_contype geom_conaffinity geom_margin geom_gap geom_solref geom_solimp
geom_bodyid geom_priority actuator_trntype actuator_trnid actuator_gear actuator_ctrlrange actuator_ctrllimited actuator_gaintype
actuator_gainprm actuator_biastype actuator_biasprm actuator_dyntype actuator_forcelimited""".split()


@pytest.mark.parametrize("field", FIELDS)
def test_ant_is_gymnasiums_field_by_field(field, gymnasium_ant):
    np.testing.assert_allclose(getattr(common.ant_spec().compile(), field), getattr(gymnasium_ant, field), atol=1e-12)


def test_half_cheetah_is_gymnasiums_field_by_field(s3):
    ours, theirs = s3.half_cheetah_spec().compile(), gymnasiums("half_cheetah")
    for field in [*FIELDS, "qpos_spring", "body_subtreemass"]:
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), atol=1e-12, err_msg=field)
    for field in ("timestep", "integrator", "gravity", "solver", "cone", "iterations", "tolerance", "density", "viscosity", "impratio"):
        np.testing.assert_array_equal(getattr(ours.opt, field), getattr(theirs.opt, field), field)
    assert common.Robots(s3.half_cheetah_spec(), 2).observe().shape == (2, 17)  # qpos[1:] and qvel, App. A.1.3


def test_ants_physics_options_and_rest_pose_are_gymnasiums(gymnasium_ant):
    ours = common.ant_spec().compile()
    for field in ("timestep", "integrator", "gravity", "solver", "cone", "iterations", "tolerance", "density", "viscosity", "impratio"):
        np.testing.assert_array_equal(getattr(ours.opt, field), getattr(gymnasium_ant.opt, field), field)
    np.testing.assert_array_equal(common.REST, gymnasium_ant.numeric("init_qpos").data)


def test_robots_equal_a_plain_loop_over_gymnasiums_ant(gymnasium_ant):
    robots, data, rng = common.Robots(common.ant_spec(), 3), mujoco.MjData(gymnasium_ant), np.random.default_rng(0)
    robots.reset(np.array([1]), rng)
    data.qpos[:], data.qvel[:] = robots.qpos[1], robots.qvel[1]
    for _ in range(40):
        action = rng.uniform(-1, 1, (3, 8)).astype(np.float32)
        displacement, unstable = robots.step(action)
        data.ctrl[:] = action[1]
        start = data.qpos[:2].copy()
        for _ in range(5):
            mujoco.mj_step(gymnasium_ant, data)
        assert not unstable.any()
        np.testing.assert_allclose(displacement[1], data.qpos[:2] - start, atol=1e-6)
    np.testing.assert_allclose(robots.qpos[1], data.qpos, atol=1e-9)
    np.testing.assert_allclose(robots.observe()[1], np.r_[data.qpos[2:], data.qvel], atol=1e-5)


def test_mirrored_ant_mirrors_its_walk():
    """The Ant mirrored at the x-axis (legs 1 and 4, 2 and 3 swapped) under mirrored actions moves by the mirrored displacement."""
    robots, rng = common.Robots(common.ant_spec(), 2), np.random.default_rng(0)
    order = {1: (2, 3), 2: (4, 5), 3: (6, 7), 4: (0, 1)}  # leg -> (hip, ankle) actuator
    swap = {1: 4, 2: 3, 3: 2, 4: 1}
    for _ in range(30):
        action = rng.uniform(-1, 1, 8)
        mirrored = np.zeros(8)
        for leg, (hip, ankle) in order.items():
            mirrored[order[swap[leg]][0]] = -action[hip]   # hips turn about z: mirrored they turn the other way
            mirrored[order[swap[leg]][1]] = action[ankle]  # bent legs stay bent: the ranges of 1 and 4, 2 and 3 agree in sign
        displacement, _ = robots.step(np.stack([action, mirrored]))
        np.testing.assert_allclose(displacement[1], displacement[0] * torch.tensor([1.0, -1.0]), atol=1e-6)
    assert abs(displacement).max() > 1e-3


def quaternion_product(a, b):
    return np.r_[a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])]


def test_what_the_egocentric_ant_sees_does_not_depend_on_north_or_on_how_its_legs_are_counted():
    """The same Ant, the world turned by any angle and the torso by k quarter turns with its legs counted on, simulated side by side."""
    rng, about_z = np.random.default_rng(0), lambda t: np.array([math.cos(t / 2), 0, 0, math.sin(t / 2)])
    turn = lambda t, v: np.array([[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)]]) @ v  # noqa: E731
    robots, angles, wanted = common.Robots(common.ant_spec(), 4), [0.0, 0.7, -2.0, 2.5], np.array([0.3, 0.2])
    robots.reset(np.arange(4), rng)
    robots.qpos[0, 3:7] += rng.normal(0, 0.3, 4)
    robots.qpos[0, 3:7] /= np.linalg.norm(robots.qpos[0, 3:7])
    knee = np.array([1, -1, -1, 1])  # legs 2 and 3 bend the other way
    for k in (1, 2, 3):
        q, v = robots.qpos, robots.qvel
        q[k, :2], q[k, 2], v[k, :2], v[k, 2], v[k, 5] = turn(angles[k], q[0, :2]), q[0, 2], turn(angles[k], v[0, :2]), v[0, 2], v[0, 5]
        q[k, 3:7] = quaternion_product(quaternion_product(about_z(angles[k]), q[0, 3:7]), about_z(k * math.pi / 2))
        v[k, 3:5] = turn(-k * math.pi / 2, v[0, 3:5])
        for leg in range(4):
            other = (leg + k) % 4
            for whole, start in ((q, 7), (v, 6)):
                hip, ankle = whole[0, start + 2 * other], whole[0, start + 2 * other + 1]
                whole[k, start + 2 * leg:start + 2 * leg + 2] = hip, ankle * knee[leg] * knee[other]
    steps = torch.tensor(np.stack([turn(t, wanted) for t in angles]), dtype=torch.float32)
    for _ in range(20):
        state, step, turns = common.egocentric(robots.observe(), steps)
        torch.testing.assert_close(state, state[:1].expand(4, -1), atol=1e-4, rtol=0)
        torch.testing.assert_close(step, step[:1].expand(4, -1), atol=1e-5, rtol=0)
        assert (abs(torch.atan2(step[:, 1], step[:, 0])) <= math.pi / 4 + 1e-5).all()
        action = torch.rand(1, 8).expand(4, -1) * 2 - 1
        displacement, _ = robots.step(common.turn_legs(action, -turns, common.ANKLES.roll(1)).numpy())
        torch.testing.assert_close(displacement, torch.tensor(np.stack([turn(t, displacement[0].numpy()) for t in angles]), dtype=torch.float32),
                                   atol=1e-4, rtol=0)
    assert len(set(turns.tolist())) > 1 and displacement.norm(dim=1).min() > 1e-3


def test_an_unstable_simulation_is_noticed_and_the_others_go_on():
    robots = common.Robots(common.ant_spec(), 3)
    robots.qvel[1] = 1e12
    displacement, unstable = robots.step(np.zeros((3, 8)))
    assert unstable.tolist() == [False, True, False] and torch.isfinite(displacement[[0, 2]]).all()
    robots.reset(np.flatnonzero(unstable))
    assert not robots.step(np.zeros((3, 8)))[1].any()


# ---------------------------------------------------------------- reward and SAC

def test_reward_is_the_scaled_log_likelihood_up_to_its_maximum(s3):
    torch.manual_seed(0)
    decoder, z, displacement = common.Decoder(3), torch.randn(40, 2), 0.1 * torch.randn(40, 2)
    mean, log_var = decoder(torch.cat([z, torch.zeros(40, 1)], 1), 1)
    for floor in (0.0, 10.0):  # without a floor: App. A.1.3; far above every deviation: the floor alone
        std = (log_var[:, 0].exp() / 20).sqrt() if floor == 0 else torch.tensor(floor)
        p = D.Independent(D.Normal(mean[:, 0] / 10, std.expand(40, 2)), 1)
        ours = s3.reward(*common.first_step(decoder, z), displacement, floor)
        torch.testing.assert_close(ours, 0.1 * (p.log_prob(displacement) - p.log_prob(mean[:, 0] / 10)))


def test_sac_gradients_equal_a_plain_version(s3):
    """Against two separate critics, frozen parameters and three separate backward passes, term by term from the paper of SAC."""
    torch.manual_seed(0)
    s3.HIDDEN, s3.TEMPERATURE = 32, 0.05
    actor, critics = common.Actor(5, 2, 3, 32), s3.Critics(10)
    value, target = s3.value_network(7), s3.value_network(7)
    x, a, x2, r = torch.randn(64, 7), torch.rand(64, 3) * 2 - 1, torch.randn(64, 7), torch.randn(64)
    torch.manual_seed(1)
    sum(s3.sac_losses(actor, critics, value, target.requires_grad_(False), x, a, x2, r)).backward()
    ours = [p.grad.clone() for p in [*actor.net.parameters(), *value.parameters(), *critics.parameters()]]
    for p in [*actor.parameters(), *value.parameters(), *critics.parameters()]:
        p.grad = None

    plain = [nn.Sequential(nn.Linear(10, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 1)) for _ in range(2)]
    for k, net in enumerate(plain):
        for i, layer in enumerate((net[0], net[2], net[4])):
            layer.weight.data, layer.bias.data = critics.weights[i][k].T.detach().clone(), critics.biases[i][k, 0].detach().clone()
    q = lambda net, action: net(torch.cat([x, action], 1)).squeeze(1)  # noqa: E731
    torch.testing.assert_close(critics(x, a), torch.stack([q(net, a) for net in plain]))
    backup = r + s3.DISCOUNT * target(x2).squeeze(1)
    sum(0.5 * nn.functional.mse_loss(q(net, a), backup) for net in plain).backward()
    critic_grads = [torch.stack([net[i].weight.grad.T for net in plain]) for i in (0, 2, 4)]
    critic_grads += [torch.stack([net[i].bias.grad[None] for net in plain]) for i in (0, 2, 4)]
    torch.manual_seed(1)
    a_new, log_prob = actor(x)
    smaller = torch.min(q(plain[0], a_new), q(plain[1], a_new))
    (0.05 * log_prob - smaller).mean().backward()
    (0.5 * nn.functional.mse_loss(value(x).squeeze(1), (smaller - 0.05 * log_prob).detach())).backward()
    expected = [p.grad for p in [*actor.net.parameters(), *value.parameters()]] + critic_grads
    for found, wanted in zip(ours, expected):
        torch.testing.assert_close(found, wanted, atol=1e-6, rtol=1e-4)


# ---------------------------------------------------------------- measures and the relation function

def test_tracking_numbers_by_hand(s3):
    angle, speed = np.tile(np.radians([-60, -30, 0, 30, 60]), 5), np.repeat([1.0, 2, 3, 4, 5], 5)
    predicted = speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    turned = angle + np.radians(10)
    executed = 0.9 * speed[:, None] * np.stack([np.cos(turned), np.sin(turned)], 1)
    error, degrees, ratio = s3.tracking(executed, predicted)
    assert error == pytest.approx(np.sqrt(1 + 0.81 - 1.8 * np.cos(np.radians(10))))
    np.testing.assert_allclose(degrees, 10)
    np.testing.assert_allclose(ratio, 0.9 * np.cos(np.radians(10)))


def test_relation_is_recovered_from_a_decoder_that_has_one(s3, monkeypatch):
    """A stand-in decoder whose heading is 0.6 z_dir and turns by 0.21 z_cur a step: the weight is 0.35."""
    def decode(z, steps):
        heading = 0.6 * z[:, 1, None] + 0.21 * z[:, 2, None] * torch.arange(steps)
        mean = torch.stack([heading.cos(), heading.sin()], 2)
        return mean, mean
    decode.axes = torch.eye(3)
    weight, miss = s3.calibrate_relation(decode)
    assert weight == pytest.approx(0.35, abs=1e-3) and miss(weight) < 1e-3 < miss(0.2)


def test_relation_of_the_half_cheetah_is_recovered_likewise(s3, monkeypatch):
    """Speed 0.5 z_speed, faster by 0.06 z_acc a step whichever way it runs: the weight is 0.12."""
    def decode(z, steps):
        mean = (0.5 * z[:, :1] + 0.06 * z[:, :1].sign() * z[:, 1:] * torch.arange(steps))[..., None]
        return mean, mean
    decode.axes = torch.eye(2)
    monkeypatch.setattr(s3, "ROBOT", "half_cheetah")
    monkeypatch.setattr(s3, "EXPERIMENT", "half_cheetah")
    weight, _ = s3.calibrate_relation(decode)
    assert abs(weight - 0.12) < 0.01  # not exact: where braking turns the direction round, sign(z) flips and the free run does not


def test_a_policy_that_is_taken_over_walks_the_steps_of_the_other_decoder(s3, monkeypatch, tmp_path):
    """Told z of the full circle it does what it does when given that decoder's step; and one that is not egocentric is refused."""
    torch.manual_seed(0)
    monkeypatch.setattr(s3, "TAKEN", "ant_semi")
    decoder = common.load_decoder(common.load(tmp_path, "wetvae", "full_circle", 0))
    taken, own = common.load_actor(s3.take(decoder)), common.load_actor(common.load(tmp_path, "policy", "ant_semi", 0))
    robots, z = common.Robots(common.ant_spec(), 20), torch.randn(20, 2)
    robots.reset(np.arange(20), np.random.default_rng(0))
    s = robots.observe()
    x, turns = own.inputs(s, z, common.predict(decoder, nn.functional.pad(z, (0, 1)), 1)[:, 0])
    assert len(own.told) and torch.equal(taken.told, own.told)  # calibrated by steps, so it holds for any decoder's
    taken.told = torch.zeros(0, 0, 2)
    torch.testing.assert_close(taken.act(s, z, True), own.seen(own(x, True)[0], -turns))
    content = common.load(tmp_path, "policy", "ant_semi", 0)
    del content["actor"]["decoder.axes"]
    monkeypatch.setattr(s3, "load", lambda *_: content)
    with pytest.raises(SystemExit):
        s3.take(decoder)


def test_steps_of_a_policy_that_misses_are_calibrated(s3, monkeypatch):
    """Robots without physics, whose torso turns, walk at 0.6 to 0.9 of what they are told and up to 20 degrees aside, by how it lies
    to their torso (the same each quarter turn): they must be told what undoes it, whichever way they face."""
    class World:
        def __init__(self, n):
            self.heading = np.zeros(n)

        def reset(self, ids, rng):
            self.heading[ids] = rng.uniform(-7, 7, len(ids))

        def observe(self):
            s = torch.zeros(len(self.heading), 27)
            s[:, 1], s[:, 4] = torch.from_numpy(np.cos(self.heading / 2)), torch.from_numpy(np.sin(self.heading / 2))
            return s

        def step(self, told):
            told = told @ np.array([1, 1j])
            seen = 4 * (np.angle(told) - self.heading)
            walked = s3.STEP_SCALE * told * (0.75 + 0.15 * np.cos(seen)) * np.exp(0.3j * np.sin(seen))
            self.heading += 0.05
            return torch.from_numpy(np.stack([walked.real, walked.imag], 1)).float(), np.zeros(len(told), bool)

    actor = common.Actor(26, 2, 8, 8, common.Decoder(3))
    for name, value in dict(make_robots=World, CALIBRATED=6, CALIBRATORS=1000, EPISODE=40).items():
        monkeypatch.setattr(s3, name, value)
    monkeypatch.setattr(actor, "follow", lambda s, step, deterministic: actor.tell(s, step))  # no network: a robot does what it is told
    actor.told = s3.calibrate_steps(actor)
    world, angle = World(200), torch.linspace(-3, 3, 200)
    world.reset(np.arange(200), np.random.default_rng(0))
    for speed in (0.1, 0.3, 0.5):  # 0.6 times the fastest that is told is 0.51
        step = speed * torch.stack([angle.cos(), angle.sin()], 1)
        untold, told = (world.step(x.numpy())[0] / s3.STEP_SCALE - step for x in (step, actor.tell(world.observe(), step)))
        assert told.norm(dim=1).mean() < 0.1 * speed and untold.norm(dim=1).mean() > 0.28 * speed
    assert actor.tell(world.observe(), 5 * step).norm(dim=1).max() < common.FASTEST + 1e-6


def test_what_is_told_lies_between_the_entries_of_the_table():
    """A step on an entry gets that entry, one between two their mean; a quarter turn of the torso or any turn of the world change nothing."""
    torch.manual_seed(0)
    actor = common.Actor(26, 2, 8, 8, common.Decoder(3))
    actor.told = 0.1 * torch.randn(5, 6, 2)

    def added(speed, angle, heading):
        s = torch.zeros(1, 27)
        s[0, 1], s[0, 4] = math.cos(heading / 2), math.sin(heading / 2)
        step = torch.polar(torch.tensor([speed]), torch.tensor([angle + heading]))
        told = actor.tell(s, torch.view_as_real(step))
        return torch.view_as_real(torch.view_as_complex(told) * step.conj() / step.abs() - step.abs())[0]

    row, column = common.FASTEST / 4, math.pi / 2 / 6
    for k in (0, 1, 7):
        for heading in (0.0, 1.0, -2.5):
            near = dict(atol=1e-4, rtol=0)
            torch.testing.assert_close(added(2 * row, 3.0001 * column + k * math.pi / 2, heading), actor.told[2, 3], **near)
            torch.testing.assert_close(added(2.5 * row, 4.0001 * column + k * math.pi / 2, heading), actor.told[2:4, 4].mean(0), **near)
            torch.testing.assert_close(added(row, 5.5 * column + k * math.pi / 2, heading), actor.told[1, [5, 0]].mean(0), **near)


# ---------------------------------------------------------------- the command line

def test_three_stages_from_the_command_line(fork, tmp_path):
    """01 -> 02 -> 03 in a new folder; 03 prints and writes what the README says it does."""
    assert fork("01_make_dataset", "--out", tmp_path, "--trajectories", 3000).returncode == 0
    done = fork("02_train_wetvae", "--out", tmp_path, "--batch", 500, "--held_out", 500, "--epochs", 2, "--baseline_epochs", 2)
    assert done.returncode == 0 and done.stdout.count("purity") == 2 * 4, done.stdout + done.stderr  # two headings, two times three axes
    assert len(common.read_csv(tmp_path / "results/wetvae.csv")) == 6 and len(common.read_csv(tmp_path / "results/crosstalk.csv")) == 18
    done = fork("03_train_policy", "--out", tmp_path, "--updates", 80, "--reports", 2, "--warm_up", 1000, "--replay", 5000,
               "--hidden", 32, "--coverage", 5, "--traversal", 3, "--starts", 1, "--calibrated", 1)
    assert done.returncode == 0 and "calibrated: z_direction " in done.stdout and f"using {tmp_path}" in done.stdout, done.stderr
    row, = common.read_csv(tmp_path / "results/policies.csv")
    assert row["experiment"] == "ant_semi" and int(row["updates"]) == 80 and float(row["tracking_error"]) > 0
    curve = common.read_csv(tmp_path / "results/learning_curve_ant_semi_seed0.csv")
    assert int(curve[-1]["updates"]) == 80
    assert f"{float(curve[-1]['tracking_error']):.3f}" == f"{float(row['tracking_error_as_trained']):.3f}"
    for name in ("fig04_latent_traversals", "fig05_skills_wedis", "learning_curve_ant_semi", "fig09_dataset"):
        assert (tmp_path / f"figures/{name}.png").stat().st_size > 10_000


def test_half_cheetah_and_full_circle_from_the_command_line(fork, tmp_path):
    for experiment, data, decoder in (("half_cheetah", "speed_acc", "speed_acc"), ("ant_full", "full", "full")):
        assert fork("01_make_dataset", "--out", tmp_path, "--experiment", data, "--trajectories", 2000).returncode == 0
        done = fork("02_train_wetvae", "--out", tmp_path, "--experiment", decoder, "--batch", 500, "--held_out", 500, "--epochs", 1,
                    "--baseline_epochs", 1)
        assert done.returncode == 0, done.stderr
        done = fork("03_train_policy", "--out", tmp_path, "--experiment", experiment, "--taken", "", "--updates", 8, "--reports", 1, "--warm_up", 640,
                   "--replay", 2000, "--hidden", 32, "--coverage", 5, "--traversal", 3, "--starts", 1, "--calibrated", 1)
        assert done.returncode == 0 and "tracking error" in done.stdout, done.stderr
    rows = common.read_csv(tmp_path / "results/policies.csv")
    assert {r["experiment"]: r["robot"] for r in rows} == dict(half_cheetah="half_cheetah", ant_full="ant")
    gaps = {r["labels"]: r["largest_gap_deg"] for r in common.read_csv(tmp_path / "results/wetvae.csv") if r["factor"] == "direction"}
    assert gaps.keys() == {"full", "circle"} and all(gaps.values())

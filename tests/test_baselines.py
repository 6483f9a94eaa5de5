"""Stage 3: DADS and SeCTAR against torch.distributions and plain loops, and through the command line into stage 4."""
import math
import signal

import common
import numpy as np
import pytest
import torch
from torch import distributions as D

TINY = ["--minutes", 0, "--updates", 32, "--reports", 2, "--robots", 8, "--warm_up", 400, "--replay", 800, "--hidden", 32, "--coverage", 3,
        "--traversal", 3, "--starts", 1, "--checkpoint", 0, "--threads", 1]
BASELINES = {"ant_dads": "dads", "ant_sectar": "sectar"}


@pytest.fixture(params=BASELINES)
def stage(request, s3):
    """Stage 3 with the constants of a baseline, and the method itself, its normalisation and likelihoods unlike those at the start."""
    s3.parse_flags(vars(s3), ["--experiment", request.param])
    torch.manual_seed(0)
    method = s3.METHODS[s3.METHOD]()
    if s3.METHOD == "dads":
        method.decoder.x_mean.copy_(torch.tensor([0.1, -0.2])), method.decoder.x_std.copy_(torch.tensor([0.5, 2.0]))
    return s3, method


def mixture(dynamics, z):
    """q(. | z) by torch.distributions, of displacements in the normalised unit."""
    logits, mean = (v.detach() for v in dynamics.mixture(z))
    return D.MixtureSameFamily(D.Categorical(logits=logits), D.Independent(D.Normal(mean, 1.0), 1))


# ---------------------------------------------------------------- DADS

def test_skill_dynamics_are_a_mixture_of_gaussians():
    torch.manual_seed(0)
    dynamics, z, x = common.SkillDynamics(), torch.rand(30, 2) * 2 - 1, torch.randn(30, 2)
    dynamics.x_mean.copy_(torch.tensor([0.3, -0.1])), dynamics.x_std.copy_(torch.tensor([0.5, 2.0]))
    torch.testing.assert_close(dynamics.log_prob(x, *dynamics.mixture(z)), mixture(dynamics, z).log_prob(x))
    every = dynamics.log_prob(x[:, None], *dynamics.mixture(z[:7]))  # all displacements under each of seven skills
    torch.testing.assert_close(every, torch.stack([mixture(dynamics, z[i:i + 1].expand(30, -1)).log_prob(x) for i in range(7)], 1))
    promised = common.predict(common.load_decoder(dict(decoder=dynamics.state_dict())), z, 3)
    expected = dynamics.x_mean + dynamics.x_std * mixture(dynamics, z).mean
    torch.testing.assert_close(promised, expected[:, None].expand(-1, 3, -1))


@pytest.mark.parametrize("stage", ["ant_dads"], indirect=True)
def test_information_is_the_published_formula(stage, monkeypatch):
    """log(L + 1) - log(1 + sum_i exp(clip(log q(x | z_i) - log q(x | z), -50, 50))), one displacement at a time."""
    s3, dads = stage
    others, z, displacement = torch.rand(s3.PRIOR_SAMPLES, 2) * 2 - 1, torch.rand(20, 2) * 2 - 1, 0.05 * torch.randn(20, 2)
    displacement[0] *= 1e5  # far away: here the differences are clipped
    with torch.no_grad():
        dads.decoder.net[4].weight *= 30
    monkeypatch.setattr(dads, "sample", lambda n: others[:n])
    found = dads.information(displacement, z)
    x = (displacement / 0.1 - dads.decoder.x_mean) / dads.decoder.x_std
    for i in range(20):
        own = mixture(dads.decoder, z[i:i + 1]).log_prob(x[i:i + 1])
        away = (mixture(dads.decoder, others).log_prob(x[i].expand(100, -1)) - own).clamp(-50, 50)
        assert found[i].item() == pytest.approx(np.log(101) - np.log1p(away.double().exp().sum().item()), abs=2e-3)
    assert found.std() > 0.1
    r, told, after = dads.reward(displacement[:, None], None, z, 0.0)
    assert told is z and after is z
    torch.testing.assert_close(r, s3.REWARD_SCALE * found)


@pytest.mark.parametrize("stage", ["ant_dads"], indirect=True)
def test_skill_dynamics_learn_what_skills_do(stage):
    """Robots whose step is a turned skill and noise: the prediction nears it and the information rises; with shuffled skills it does not."""
    s3, dads = stage
    turn = torch.tensor([[0.0, 0.04], [-0.04, 0.0]])
    adam = torch.optim.Adam(dads.model.parameters(), lr=1e-3)
    for _ in range(60):
        z = dads.sample(256)
        loss = dads.loss(None, None, (z @ turn + 0.01 * torch.randn(256, 2))[:, None], z[:, None], None)
        adam.zero_grad()
        loss.backward()
        adam.step()
    z = dads.sample(500)
    step = z @ turn
    with torch.no_grad():
        assert dads.measure(step[:, None], z[:, None]) > 0.3 > 0.0 > dads.measure(step[torch.randperm(500), None], z[:, None])
    assert (0.1 * common.predict(dads.decoder, z, 1)[:, 0] - step).square().mean().sqrt() < 0.3 * step.square().mean().sqrt()


# ---------------------------------------------------------------- SeCTAR

@pytest.mark.parametrize("stage", ["ant_sectar"], indirect=True)
def test_elbo_and_rewards_equal_torch_distributions(stage):
    """The steps of a trajectory are together worth how far from the decoded place it ends: to a skill as a cost, to the explorer as a gain."""
    s3, sectar = stage
    displacement, t, floor = 0.03 * torch.randn(6, 50, 2), torch.randint(50, (3, 6)), 0.05
    x = displacement / 0.1
    with torch.no_grad():
        sectar.encoder.head.bias[:8] = 3.0  # a divergence that counts
        sectar.decoder.head[2].bias[2:] = torch.tensor([-1.0, -9.0])  # the second coordinate's deviation is below every floor
        torch.manual_seed(1)
        log_p, kl, steps = sectar.elbo(x)
        torch.manual_seed(1)
        z, _ = sectar.posterior(x)
        torch.manual_seed(1)
        mean, log_var = sectar.encoder(x)
        q = D.Independent(D.Normal(mean, (0.5 * log_var).exp()), 1)
        torch.testing.assert_close(z, mean + (0.5 * log_var).exp() * torch.randn(6, 8))
        torch.testing.assert_close(kl, D.kl_divergence(q, D.Independent(D.Normal(torch.zeros(6, 8), 1.0), 1)))

        def p(z, least):
            m, v = sectar.decoder(z, 50)
            return m, D.Normal(m, torch.maximum((0.5 * v).exp(), torch.tensor(least)))
        torch.testing.assert_close(steps, p(z, 0.1)[0])
        torch.testing.assert_close(log_p, p(z, 0.1)[1].log_prob(x).sum((1, 2)), atol=1e-3, rtol=1e-4)

        skills = torch.randn(6, 8)
        skills[4:] = sectar.explorers(2)
        torch.manual_seed(1)
        r, told, after = sectar.reward(displacement, t, skills, floor)
        torch.manual_seed(1)
        z, _ = sectar.posterior(x[4:])
        for k, (n, i) in enumerate((n, i) for n in range(3) for i in range(6)):
            m, _ = p(z[i - 4:i - 3] if i > 3 else skills[i:i + 1], 0.1)
            away = (x[i] - m[0]).sum(0)
            expected = 0.3 * (1 if i > 3 else -1) * (x[i] - m[0])[t[n, i]] @ away / away.norm()
            assert r[k].item() == pytest.approx(float(expected), abs=1e-4)
            m = skills[i, :2].expand(1, 50, 2) if i > 3 else m  # what the policy is told then and at the next step
            torch.testing.assert_close(torch.stack([told[k], after[k]]), torch.stack([m[0, t[n, i]], m[0, min(49, t[n, i] + 1)]]))


@pytest.mark.parametrize("stage", ["ant_sectar"], indirect=True)
def test_cloning_moves_the_policy_towards_the_actions_and_reaches_the_encoder(stage):
    s3, sectar = stage
    torch.manual_seed(0)
    actor, s, a, x = common.Actor(26, 2, 8, 16, sectar.decoder), torch.randn(4, 50, 27), torch.full((4, 50, 8), 0.7), 0.03 * torch.randn(4, 50, 2)
    s3.KL_WEIGHT, s3.CLONING = 0.0, 1e6  # what is left is cloning
    z = sectar.explorers(4)[:, None].expand(-1, 50, -1)
    s[..., 1:5] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    with torch.no_grad():
        sectar.decoder.head[2].bias[:2] = torch.tensor([-0.3, 1.0])  # all face along x and are told to go to their left: one view
    sectar.loss(s, a, x, z, actor).backward()
    assert sectar.encoder.head.weight.grad.abs().sum() > 0

    def miss():
        """Between the policy's action on each decoded step and that of the motors, both from the Ant's view."""
        with torch.no_grad():
            seen, turns = actor.inputs(s.flatten(0, 1), None, sectar.elbo(x / 0.1)[2].flatten(0, 1))
            return (actor(seen, deterministic=True)[0] - actor.seen(a.flatten(0, 1), turns)).square().mean()

    before, adam = miss(), torch.optim.Adam(actor.net.parameters(), lr=3e-3)
    for _ in range(100):
        adam.zero_grad()
        sectar.loss(s, a, x, z, actor).backward()
        adam.step()
    assert miss() < 0.3 * before


@pytest.mark.parametrize("stage", ["ant_sectar"], indirect=True)
def test_the_explorer_has_its_share_and_can_be_switched_off(stage):
    s3, sectar = stage
    z = sectar.sample(4000)
    explorer = (z[:, 2:] == s3.EXPLORER).all(1)
    torch.testing.assert_close(z[explorer, :2].norm(dim=1), torch.full((int(explorer.sum()),), s3.EXPLORER))
    assert explorer.float().mean() == pytest.approx(0.5, abs=0.03) and z[~explorer].std() == pytest.approx(1, abs=0.03)
    s3.EXPLORE = 0.0
    assert not (sectar.sample(4000) == s3.EXPLORER).any()


@pytest.mark.parametrize("env_steps", [3200, 6500, 9600, 40_000])
def test_trajectories_are_runs_of_one_robot(s3, env_steps):
    """A replay that says when and by whom each row was written, also when it has been overwritten several times."""
    torch.manual_seed(0)
    replay = torch.full((9600, 2), -1)
    for step in range(env_steps // 64):
        replay[torch.arange(step * 64, step * 64 + 64) % 9600] = torch.stack([torch.full((64,), step), torch.arange(64)], 1)
    for recent in (3200, 6400, 9600):
        when, who = replay[s3.trajectories(400, 50, env_steps, replay, recent)].unbind(2)
        assert (when.diff(dim=1) == 1).all() and (when[:, 0] % 50 == 0).all() and (who == who[:, :1]).all() and len(who[:, 0].unique()) > 50
        assert when.max() < env_steps // 64 and when.min() >= max(0, env_steps // 64 - recent // 64 - 50)


# ---------------------------------------------------------------- measures

def test_matching_finds_the_axes(s3):
    C = np.array([[0.1, 0.1, 0.1], [0.0, 0.9, 0.1], [0.8, 0.1, 0.0], [0.7, 0.0, 0.0], [0.0, 0.1, 0.5]])
    assert {f: axis for f, (axis, _) in s3.match(C).items()} == {0: 3, 1: 1, 2: 4}
    assert s3.match(C)[1][1] == pytest.approx(0.9)
    assert {f: axis for f, (axis, _) in s3.match(C[:, [0, 1, 2]][1:3]).items()} == {1: 0, 0: 1}  # two axes: a factor has none


# ---------------------------------------------------------------- the command line

@pytest.fixture(scope="module")
def made(tmp_path_factory, fork):
    """A folder in which both baselines were trained a little, and what the runs printed."""
    out = tmp_path_factory.mktemp("baselines")
    printed = {}
    for experiment in BASELINES:
        done = fork("03_train_policy", "--out", out, "--experiment", experiment, *TINY)
        assert done.returncode == 0, done.stderr
        printed[experiment] = done.stdout
    return out, printed


def test_both_baselines_from_the_command_line(made):
    out, printed = made
    rows = {row["experiment"]: row for row in common.read_csv(out / "results/policies.csv")}
    extra = {(row["method"], row["what"]): float(row["value"]) for row in common.read_csv(out / "results/baselines.csv")}
    for experiment, method in BASELINES.items():
        row = rows[experiment]
        assert row["method"] == method and int(row["updates"]) == 32 and int(row["env_steps"]) == 400 + 8 * 3
        assert f"tracking error {float(row['tracking_error']):.3f}" in printed[experiment] and float(row["tracking_error_sampled"]) > 0
        assert sum(bool(row[f"purity_{name}"]) for name in ("speed", "direction", "curvature")) == dict(dads=2, sectar=3)[method]
        curve = common.read_csv(out / f"results/learning_curve_{experiment}_seed0.csv")
        assert extra[method, "metric_last"] == pytest.approx(float(curve[-1]["metric"]), rel=1e-4)
        for name in (f"fig05_skills_{method}", f"learning_curve_{experiment}"):
            assert (out / f"figures/{name}.png").stat().st_size > 10_000
    assert {what for method, what in extra if method == "dads"} >= {"r2_of_1_steps", "r2_of_20_steps"}
    assert {what for method, what in extra if method == "sectar"} >= {"reconstruction_error", "self_consistency_error", "explorer_coverage_cells"}


def act_on_step(actor, s, step):
    x, turns = actor.inputs(s, None, step)
    return actor.seen(actor(x, True)[0], -turns)


@pytest.mark.parametrize("method, z_dim, length, hold", [("dads", 2, 1, 20), ("sectar", 8, 40, 1)])
def test_stage_4_loads_them_and_believes_them(made, s4, method, z_dim, length, hold, monkeypatch):
    """The same calls as for WEDIS: all of z goes to the policy, and what is promised is the mean of the method's own model."""
    monkeypatch.setattr(s4, "OUT", made[0])
    skills = s4.Skills(method, "maze1").load()
    assert (skills.single, len(skills.top), skills.weight, skills.predictions) == (z_dim, z_dim, None, ["decoder"])
    z = torch.rand(5, z_dim) * 2 - 1
    content = common.load(made[0], "policy", f"ant_{method}", 0)
    if method == "dads":
        dynamics = common.load_decoder(content)
        one = 0.1 * (dynamics.x_mean + dynamics.x_std * mixture(dynamics, z).mean)[:, None]
    else:
        decoder = common.Decoder(8)
        decoder.load_state_dict(content["decoder"])
        one = 0.1 * decoder(z, length)[0].detach()
    torch.testing.assert_close(skills.promise(z, "decoder"), hold * one)
    robots = common.Robots(common.ant_spec(), 5)
    walk = common.execute(skills.actor, robots, z, 3, 1, None, True)
    for t in range(3):  # what 03 executes is what 04 does; SeCTAR's policy is told the decoded steps one after the other
        action = skills.actor.act(robots.observe(), z[:, :skills.single], True, t)
        step = z if method == "dads" else decoder(z, 3)[0][:, t].detach()
        torch.testing.assert_close(action, skills.actor.act(robots.observe(), z, True) if method == "dads" else
                                   act_on_step(skills.actor, robots.observe(), step))
        next(walk)
        np.testing.assert_array_equal(robots.ctrl, action.numpy().astype(np.float64))


@pytest.mark.parametrize("experiment", BASELINES)
def test_a_baseline_that_was_killed_ends_with_the_same_bits(made, fork, tmp_path, experiment):
    file = tmp_path / "runs" / common.artifact_name("policy-checkpoint", experiment, 0)
    fork.start("03_train_policy", "--out", tmp_path, "--experiment", experiment, *TINY)
    fork.wait_for(file.exists)
    assert fork.end(signal.SIGKILL).returncode == -signal.SIGKILL and common.load(tmp_path, "policy-checkpoint", experiment, 0)["updates"] < 32
    fork.start("03_train_policy", "--out", tmp_path, "--experiment", experiment, *TINY, "--resume", "true")
    fork.wait_for((tmp_path / "runs" / common.artifact_name("policy", experiment, 0)).exists)
    fork.end(signal.SIGKILL)
    whole, cut = (common.load(out, "policy-checkpoint", experiment, 0) for out in (made[0], tmp_path))
    for content in (whole, cut):  # compare all but the clock and the flags
        for row in [content, *content["curve"]]:
            for entry in ("seconds", "minutes", "config", "sha256"):
                row.pop(entry, None)
    assert [key for key in whole if common.checksum({key: whole[key]}) != common.checksum({key: cut[key]})] == []


def test_settings_that_do_not_fit_trajectories_are_refused_with_one_line(fork, tmp_path):
    done = fork("03_train_policy", "--out", tmp_path, "--experiment", "ant_sectar", "--warm_up", 1000)
    assert done.returncode == 2 and "--warm_up must be at least 3200" in done.stderr and done.stderr.count("\n") == 1
    done = fork("03_train_policy", "--out", tmp_path, "--method", "ppo")
    assert done.returncode == 2 and "unknown method 'ppo'; allowed: wedis dads sectar" in done.stderr


def test_dads_takes_z_for_a_step_and_turns_it_with_the_ant():
    """The same Ant in a world turned by an angle, z turned with it: the same action of its motors."""
    torch.manual_seed(0)
    actor, t = common.Actor(26, 2, 8, 16, None, True), 0.4
    s, z = torch.randn(6, 27), torch.randn(6, 2)
    s[:, 1:5] /= s[:, 1:5].norm(dim=1, keepdim=True)
    turn = torch.tensor([[math.cos(t), math.sin(t)], [-math.sin(t), math.cos(t)]])  # rows are turned from the right
    half = torch.tensor([[math.cos(t / 2), math.sin(t / 2)], [-math.sin(t / 2), math.cos(t / 2)]])
    there = s.clone()
    there[:, [1, 4]], there[:, [2, 3]] = s[:, [1, 4]] @ half, s[:, [2, 3]] @ half  # of (cos t/2, 0, 0, sin t/2) times the quaternion
    there[:, 13:15] = s[:, 13:15] @ turn
    torch.testing.assert_close(actor.act(there, z @ turn, True), actor.act(s, z, True), atol=1e-5, rtol=0)
    assert (actor.act(there, z, True) - actor.act(s, z, True)).abs().max() > 1e-3

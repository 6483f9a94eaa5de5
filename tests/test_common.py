"""Command line, artifacts, labels, decoder, actor: against closed forms and torch.distributions."""
import math
import pickle

import common
import numpy as np
import pytest
import torch
from conftest import script
from torch import distributions as D


# ---------------------------------------------------------------- command line

def flags(*argv):
    stage = vars(script("04_mpc_maze"))
    return common.parse_flags(stage, list(argv)), stage


def test_flags_override_rows_and_rows_override_constants():
    stage = vars(script("04_mpc_maze"))
    stage["EXPERIMENTS"]["short"] = dict(TRIALS=7, SAMPLES=9)
    config = common.parse_flags(stage, ["--experiment", "short", "--samples", "11", "--animate", "false"])
    assert (stage["TRIALS"], stage["SAMPLES"], stage["HOLD"], stage["ANIMATE"]) == (7, 11, 40, False)
    assert config["TRIALS"] == 7 and config["SAMPLES"] == 11


def test_every_constant_is_a_flag_with_its_comment(capsys):
    with pytest.raises(SystemExit) as end:
        flags("--help")
    text = " ".join(capsys.readouterr().out.split())
    assert end.value.code == 0 and "--samples int N, skill sequences per plan [1000]" in text


# ---------------------------------------------------------------- artifacts

def test_artifacts_come_back_as_they_went(tmp_path):
    common.save(tmp_path, "policy", "x", 3, dict(A=1), w=torch.arange(4.0), curve=[dict(a=1.5)])
    common.save(tmp_path, "dataset", "x", 3, dict(A=1), t=np.eye(2))
    policy, dataset = common.load(tmp_path, "policy", "x", 3), common.load(tmp_path, "dataset", "x", 3)
    assert torch.equal(policy["w"], torch.arange(4.0)) and policy["curve"] == [dict(a=1.5)] and policy["config"] == dict(A=1)
    assert np.array_equal(dataset["t"], np.eye(2)) and dataset["versions"]["numpy"] == np.__version__
    assert sorted(p.name for p in (tmp_path / "runs").iterdir()) == ["dataset_x_seed3.npz", "policy_x_seed3.pt"]


def test_runs_come_before_pretrained(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(common, "HERE", tmp_path / "repo")
    common.save(tmp_path / "repo", "policy", "x", 0, {}, v=1)
    (tmp_path / "repo" / "runs").rename(tmp_path / "repo" / "pretrained")
    assert common.load(tmp_path, "policy", "x", 0)["v"] == 1 and "pretrained" in capsys.readouterr().out
    common.save(tmp_path, "policy", "x", 0, {}, v=2)
    assert common.load(tmp_path, "policy", "x", 0)["v"] == 2


@pytest.mark.parametrize("kind", ["dataset", "policy"])
@pytest.mark.parametrize("damage", ["cut", "flip", "foreign", "other seed", "other kind", "old format"])
def test_damaged_artifacts_are_refused_in_one_line(kind, damage, tmp_path, capsys, monkeypatch):
    if damage == "old format":
        monkeypatch.setattr(common, "FORMAT", 0)
    path = common.save(tmp_path, kind, "x", 5 if damage == "other seed" else 0, {}, v=np.ones(50) if kind == "dataset" else torch.ones(50))
    monkeypatch.undo()
    wanted = path.with_name(common.artifact_name(kind, "x", 0))
    path.rename(wanted)
    data = bytearray(wanted.read_bytes())
    if damage == "flip":
        data[data.find(b"\xf0\x3f" if kind == "dataset" else b"\x80\x3f") + 1] ^= 1  # inside an array of ones
    wanted.write_bytes({"cut": data[:len(data) // 2], "foreign": b"not an archive"}.get(damage, data))
    if damage == "other kind":
        kind = "wetvae" if kind == "policy" else "dataset"
        wanted.rename(wanted.with_name(common.artifact_name(kind, "y", 0)))
    with pytest.raises(SystemExit) as end:
        common.load(tmp_path, kind, "y" if damage == "other kind" else "x", 0)
    message = capsys.readouterr().err
    assert end.value.code == 2 and message.count("\n") == 1 and f"python {common.SCRIPT[kind]}" in message


def test_a_pickle_in_disguise_is_not_executed(tmp_path):
    class Evil:
        def __reduce__(self):
            return exec, (f"open({str(tmp_path / 'owned')!r}, 'w')",)
    (tmp_path / "runs").mkdir()
    torch.save(Evil(), tmp_path / "runs" / "policy_x_seed0.pt")
    (tmp_path / "runs" / "dataset_x_seed0.npz").write_bytes(pickle.dumps(Evil()))
    for kind in ("policy", "dataset"):
        with pytest.raises(SystemExit):
            common.load(tmp_path, kind, "x", 0)
    assert not (tmp_path / "owned").exists()


def test_a_write_that_fails_leaves_the_old_artifact(tmp_path, monkeypatch):
    common.save(tmp_path, "policy", "x", 0, {}, v=1)

    def full(*_):
        raise OSError(28, "No space left on device")
    monkeypatch.setattr(common.torch, "save", full)
    with pytest.raises(SystemExit) as end:
        common.save(tmp_path, "policy", "x", 0, {}, v=2)
    assert end.value.code == 1 and common.load(tmp_path, "policy", "x", 0)["v"] == 1
    assert [p.name for p in (tmp_path / "runs").iterdir()] == ["policy_x_seed0.pt"]


def test_csv_rows_are_replaced_by_key(tmp_path):
    path = tmp_path / "results" / "t.csv"
    common.update_csv(path, [dict(a="x", n=1, v=0.5), dict(a="y", n=1, v=0.25)], ("a", "n"))
    common.update_csv(path, [dict(a="x", n=1, v=2.0)], ("a", "n"))
    assert path.read_text() == "a,n,v\ny,1,0.25\nx,1,2\n"


# ---------------------------------------------------------------- labels, factors, cross-talk

def test_labels_of_the_papers_example():
    """App. A.1.1: speed 0.1, direction 40 degrees, curvature -10 degrees has the labels one, two, three."""
    factors = dict(speed=np.array([0.1]), direction=np.radians([40.0]), curvature=np.radians([-10.0]))
    assert (common.weak_labels(factors, ["speed", "direction", "curvature"])[0] + 1).tolist() == [1, 2, 3]


def test_labels_at_the_ends_of_the_ranges():
    factors = dict(speed=np.array([0.0, 0.25, 1.0]), direction=np.radians([90.0, 0.1, -90.0]), curvature=np.array([0.0, 0.1, -0.1]))
    assert (common.weak_labels(factors, ["speed", "direction", "curvature"]) + 1).tolist() == [[1, 1, 1], [2, 2, 2], [4, 4, 3]]


def test_factors_are_read_back_from_trajectories(s1):
    rng = np.random.default_rng(0)
    speed, direction, curvature = rng.uniform(0.1, 1, 100), rng.uniform(-3, 3, 100), rng.uniform(-0.5, 0.5, 100)
    found = common.factors_of(np.diff(s1.make_trajectories(speed, direction, curvature, length=5), axis=1))
    for name, true in dict(speed=speed, direction=direction, curvature=curvature).items():
        np.testing.assert_allclose(found[name], true, atol=1e-12)


def test_cross_talk_and_purity_by_hand():
    curves = [dict(speed=np.array([0, 0.8]), direction=np.array([0, math.pi * 0.2])),
              dict(speed=np.array([0.3, 0.3]), direction=np.array([-math.pi / 2, math.pi / 2]))]
    C, purity = common.cross_talk(curves, ["speed", "direction"], [1, math.pi])
    np.testing.assert_allclose(C, [[0.8, 0.2], [0, 1]])
    np.testing.assert_allclose(purity, [0.8, 1])


# ---------------------------------------------------------------- decoder, relation function, actor

def test_decoder_feeds_on_its_own_mean_and_is_causal():
    torch.manual_seed(0)
    decoder, z = common.Decoder(3), torch.randn(7, 3)
    mean, log_var = decoder(z, 5)
    assert mean.shape == log_var.shape == (7, 5, 2)
    torch.testing.assert_close(decoder(z, 3)[0], mean[:, :3])
    state = None  # the same roll-out, step by step, by hand
    x = torch.zeros(7, 2)
    for t in range(5):
        state = decoder.cell(torch.cat([x, z], 1), state)
        x = decoder.head(state[0])[:, :2]
        torch.testing.assert_close(x, mean[:, t])


def test_canonical_axes_permute_and_flip():
    torch.manual_seed(0)
    decoder, z = common.Decoder(3), torch.randn(4, 3)
    plain = decoder(torch.stack([z[:, 2], -z[:, 0], z[:, 1]], 1), 2)[0]
    decoder.axes = torch.tensor([[0.0, -1, 0], [0, 0, 1], [1, 0, 0]])
    torch.testing.assert_close(decoder(z, 2)[0], plain)


def test_gaussian_log_prob_is_torchs(s2):
    x, mean, log_var = torch.randn(3, 50, 2)
    torch.testing.assert_close(s2.gaussian_log_prob(x, mean, log_var), D.Normal(mean, (0.5 * log_var).exp()).log_prob(x))


def test_prediction_under_the_relation_function_is_a_chain_of_first_steps():
    torch.manual_seed(0)
    decoder, z, weight = common.Decoder(3), torch.randn(6, 3), 0.3
    path = common.predict(decoder, z, 4, weight)
    for t in range(4):
        single = torch.stack([z[:, 0], z[:, 1] + t * weight * z[:, 2], torch.zeros(6)], 1)
        torch.testing.assert_close(path[:, t], decoder(single, 1)[0][:, 0])
    torch.testing.assert_close(common.predict(decoder, z, 4), decoder(z, 4)[0])


def test_actor_log_probability_is_torchs():
    torch.manual_seed(0)
    actor = common.Actor(5, 2, 3, 32)
    x, _ = actor.inputs(torch.randn(200, 5), torch.randn(200, 2))
    action, log_prob = actor(x)
    mean, log_std = actor.net(x).chunk(2, 1)
    oracle = D.TransformedDistribution(D.Normal(mean, log_std.clamp(-5, 2).exp()), D.TanhTransform(cache_size=1))
    inside = (action.abs() < 0.999).all(1)  # where tanh can be inverted in float32
    assert inside.sum() > 100
    torch.testing.assert_close(log_prob[inside], oracle.log_prob(action).sum(1)[inside], atol=2e-3, rtol=1e-3)
    torch.testing.assert_close(actor(x, deterministic=True)[0], torch.tanh(mean))

"""Stage 4: geometry against dense sampling and a visibility graph, Algorithm 2 against plain loops, the three modes, rewards
counted by hand, Table 2, rows and flags, results that are used again or not, the command line. All policies are tiny."""
import itertools
from dataclasses import replace
from types import SimpleNamespace

import common
import numpy as np
import pytest
import torch
from conftest import cli, load_policy
from extras import render

COLUMNS = "maze reward method mode look_ahead samples seed policy_seed policy settings trial final_distance success".split()
MODES = ["printed", "commands", "closed"]


def make_policy(folder, experiment, seed=0, decoder=None, **changed):
    """Save a tiny policy artifact and return it as stage 4 loads it."""
    torch.manual_seed(seed)
    decoder = decoder or common.Decoder(3, 2, 16)
    content = dict(actor=common.Actor(27, 2, 8, 8, True), decoder=decoder, method="wedis", robot="ant",
                   names=["speed", "direction", "curvature"], relation=dict(curvature=0.3), scale=0.1)
    common.save(folder, "policy", experiment, seed, {}, **content | changed)
    return load_policy(folder, experiment, seed)


@pytest.fixture(scope="session")
def policies(tmp_path_factory):
    """A folder with three policies of each method, and one of another robot."""
    folder = tmp_path_factory.mktemp("policies")
    for seed in (0, 1, 2):
        make_policy(folder, "ant_semi", seed)
    baseline = dict(names=[], relation={})
    for seed in (0, 1, 2):
        make_policy(folder, "ant_dads", seed, decoder=common.Decoder(2, 2, 8), method="dads", **baseline)
        make_policy(folder, "ant_sectar", seed, decoder=common.Decoder(2, 2, 8), method="sectar", **baseline)
    make_policy(folder, "half_cheetah", decoder=common.Decoder(2, 1, 8), robot="half_cheetah")
    return folder


@pytest.fixture
def out(policies, tmp_path):
    for path in policies.glob("*.pt"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


@pytest.fixture
def stage(s4, out, monkeypatch, capsys):
    """Runs stage 4 in this process, small unless flags say else: stage(*flags) -> exit code, rows, stdout, stderr."""
    robots = out / "nothing" / "robots"
    robots.mkdir(parents=True)
    for path in (common.HERE / "robots").glob("*.xml"):
        (robots / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(s4.common, "HERE", out / "nothing")  # what is shipped must not matter
    small = dict(out=out, trials=2, samples=4, episode=200, pool=64, threads=1, draw="fig06")

    def run(*flags, **changed):
        given = {name: value for name, value in (small | changed).items() if value is not None}
        monkeypatch.setattr("sys.argv", ["04_mpc_maze.py", *(
            text for name, value in given.items() for text in ("--" + name, str(value))), *flags])
        fresh = {name: value for name, value in vars(s4).items() if name.isupper()}
        code = 0
        try:
            s4.main()
        except SystemExit as end:
            code = end.code
        experiment = s4.EXPERIMENT
        vars(s4).update(fresh)
        path = out / "results" / f"{experiment}.csv"
        printed = capsys.readouterr()
        rows = common.read_csv(path) if path.exists() else []
        return SimpleNamespace(code=code, rows=rows, out=printed.out, err=printed.err)
    return run


def runs(s4, out, **flags):
    """What a run with these flags plans: [(configuration, policy, settings)]."""
    before = {name: value for name, value in vars(s4).items() if name.isupper()}
    argv = [text for name, value in (dict(out=out) | flags).items() for text in ("--" + name, str(value))]
    try:
        return s4.check(*common.parse_flags(vars(s4), argv))
    finally:
        vars(s4).update(before)


def only(s4, out, method="wedis", maze="maze1", mode="printed", reward="dense", **changed):
    """One configuration and its policy."""
    flags = dict(method=method, mazes=maze, modes=mode, rewards=reward, samples=50, policy_seeds=0, threads=1)
    (c, policy, _), = runs(s4, out, **flags)
    return replace(c, pool=256, **changed), policy


# ---------------------------------------------------------------- geometry

def shortest_path(s4, walls, goal, radius):
    """Length of the shortest path from the start to the goal, by a visibility graph of the corners of the grown walls."""
    grown = [(x0 - radius, x1 + radius, y0 - radius, y1 + radius) for x0, x1, y0, y1 in walls]
    nodes = [(0.0, 0.0), goal, *((x, y) for x0, x1, y0, y1 in grown for x in (x0, x1) for y in (y0, y1))]
    nodes = np.array([(x, y) for x, y in nodes if not any(x0 < x < x1 and y0 < y < y1 for x0, x1, y0, y1 in grown)])
    ends = torch.tensor(np.array(list(itertools.product(nodes, repeat=2))), dtype=torch.float32)
    seen = ~s4.collides(ends, walls, radius - 1e-3).numpy().reshape(len(nodes), len(nodes))
    length = np.where(seen, np.linalg.norm(nodes[:, None] - nodes, axis=2), np.inf)
    for k in range(len(nodes)):
        length = np.minimum(length, length[:, k, None] + length[k])
    return length[0, 1]


def test_the_shortest_path_is_known_where_it_is_simple(s4):
    assert shortest_path(s4, [(4, 6, -9, 2)], (10.0, 0.0), 1.0) == pytest.approx(2 * np.hypot(3, 3) + 4, abs=0.01)
    assert shortest_path(s4, [(5, 5, -9, 3)], (10.0, 0.0), 0.0) == pytest.approx(2 * np.hypot(5, 3), abs=0.01)
    assert shortest_path(s4, [], (3.0, 4.0), 1.0) == pytest.approx(5)


@pytest.mark.parametrize("maze", ["maze1", "maze2"])
def test_the_way_to_the_goal_is_36_metres_and_not_straight(s4, maze):
    """App. A.1.4: as the straight paths are blocked, the effective distance to goals is 36."""
    walls = s4.MAZE[maze]["WALLS"]
    assert np.hypot(*s4.GOAL) == pytest.approx(26.8, abs=0.05)
    assert s4.collides(torch.tensor([[[0.0, 0.0], s4.GOAL]]), walls, s4.RADIUS).all()
    assert s4.collides(torch.tensor([[[0.0, 0.0], s4.GOAL]]), walls, 0.0).all()
    assert shortest_path(s4, walls, s4.GOAL, s4.RADIUS) == pytest.approx(36, abs=1)


def test_mazes_are_closed_and_fig_18_has_a_way(s4):
    for maze in ("maze1", "maze2", "s_maze", "obstacles"):
        row = s4.MAZE[maze]
        goal = tuple(map(float, row.get("GOAL", s4.GOAL)))
        assert shortest_path(s4, row["WALLS"], goal, s4.RADIUS) < 45
        rays = torch.tensor([[[0.0, 0.0], [99 * np.cos(a), 99 * np.sin(a)]] for a in np.linspace(0, 6.3, 5000)], dtype=torch.float32)
        assert s4.collides(rays, row["WALLS"], 0.0).all(), maze


@pytest.mark.parametrize("maze, step, n, length", [("maze1", 30, 400, 2), ("s_maze", 30, 400, 2),
                                                   ("obstacles", 0.3, 400, 2), ("maze2", 2, 40, 45)])
def test_collisions_agree_with_dense_sampling(s4, maze, step, n, length):
    rng = np.random.default_rng(0)
    path = np.pad(np.cumsum(rng.uniform(-step, step, (n, length, 2)), 1), ((0, 0), (1, 0), (0, 0)))
    path += rng.uniform([-8, -12], [33, 20], (n, 1, 2))
    found = s4.collides(torch.from_numpy(path.astype(np.float32)), s4.MAZE[maze]["WALLS"], 1.0).numpy()
    points = path[:, :-1, None] + np.linspace(0, 1, 1501)[:, None] * np.diff(path, axis=1)[:, :, None]
    hit = np.zeros((n, length), bool)
    for x0, x1, y0, y1 in s4.MAZE[maze]["WALLS"]:
        hit |= ((points >= (x0 - 1, y0 - 1)) & (points <= (x1 + 1, y1 + 1))).all(3).any(2)
    assert (hit != found).sum() <= 2  # sampling misses a corner cut shorter than its step
    assert 0.05 < found.mean() < 0.95


def test_a_transition_that_stands_still_collides_where_it_stands(s4):
    still = torch.tensor([[[7.0, 0.0]] * 2, [[9.4, 0.0]] * 2, [[10.6, 0.0]] * 2])
    assert s4.collides(still, [(9, 10, -1, 1)], 0.5).flatten().tolist() == [False, True, False]


def test_walls_stop_the_ant(s4):
    robots = common.Robots(s4.maze_spec(SimpleNamespace(walls=[(1.2, 2.2, -5, 5)], goal=(3.0, 0.0))), 2, 1)
    robots.qpos[1, 0] = -20
    for _ in range(60):
        robots.qvel[:, 0] = 1  # pushed along x
        robots.step(np.zeros((2, 8)))
    assert robots.qpos[0, 0] < 1.2 and robots.qpos[1, 0] > -20 + 2


# ---------------------------------------------------------------- Algorithm 2

@pytest.fixture
def lively():
    """A policy with a decoder whose paths differ."""
    torch.manual_seed(0)
    decoder = common.Decoder(3, 2, 16).requires_grad_(False)
    decoder.head[2].weight *= 20
    return SimpleNamespace(decoder=decoder, names=["speed", "direction", "curvature"], relation=dict(curvature=0.3),
                           method="wedis", scale=0.1, sha256="0" * 64)


def test_skills_are_those_of_app_a14(s4, out, lively):
    """U(-1.5, 1.5), of the speed U(0, 1.5)."""
    c = replace(only(s4, out)[0], pool=4096)
    z, _ = s4.skill_pool(c, lively)
    assert z.shape == (4096, 3) and z.abs().max() <= 1.5
    assert z[:, 0].min() >= 0 and z[:, 1:].min(0).values.max() < -1.49
    assert z.mean(0).tolist() == pytest.approx([0.75, 0, 0], abs=0.06)
    lively.names = []  # of DADS and SeCTAR: all axes alike
    assert s4.skill_pool(c, lively)[0].min(0).values.max() < -1.49


def test_printed_predicts_by_the_decoder_that_reads_its_own_mean(s4, out, lively):
    z, delta = s4.skill_pool(only(s4, out)[0], lively)
    mean, state = torch.zeros(256, 2), None
    for t in range(5):
        state = lively.decoder.cell(torch.cat([mean, z], 1), state)
        mean = lively.decoder.head(state[0])[:, :2]
        torch.testing.assert_close(delta[:, t], mean)
    assert delta.std() > 0.02


def test_commands_and_closed_predict_what_the_robot_is_commanded(s4, out):
    c, policy = only(s4, out, mode="commands")
    z, delta = s4.skill_pool(c, policy)
    for t in range(5):
        single = torch.stack([z[:, 0], z[:, 1] + 0.3 * t * z[:, 2], torch.zeros(256)], 1)  # f_dir, t times
        torch.testing.assert_close(delta[:, t], policy.decoder(single, 1)[0][:, 0], atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(delta, common.commands_of(policy, z, 5))
    closed, printed = (s4.skill_pool(replace(c, mode=mode), policy) for mode in ("closed", "printed"))
    assert torch.equal(delta, closed[1]) and not torch.allclose(delta, printed[1])
    assert torch.equal(z, closed[0]) and torch.equal(z, printed[0])  # the same skills


def test_a_scaled_arc_has_its_closed_form(s4, out):
    """Steps of length d that turn by a each end at d (1 - e^{iaK}) / (1 - e^{ia}); scaling stretches that by H_z."""
    angle = 0.2 * torch.arange(12)
    delta = torch.stack([torch.cos(angle), torch.sin(angle)], 1)[None]
    for hold in (1, 40):
        c, policy = only(s4, out, hold=hold, episode=24 * hold, length=12, samples=3)
        _, path = s4.plan(c, policy, (torch.zeros(1, 3), delta), 2, torch.tensor([3.0, 4.0]))  # the only skill, twice
        arc = policy.scale * hold * (1 - np.exp(12j * 0.2)) / (1 - np.exp(0.2j))
        wanted = [[(3 + 4j + n * arc).real, (3 + 4j + n * arc).imag] for n in range(3)]
        assert path.shape == (25, 2) and path[::12].tolist() == [pytest.approx(place, rel=1e-5) for place in wanted]


def test_rewards_are_those_of_sec_62(s4, out):
    c, _ = only(s4, out)
    c = replace(c, goal=(10.0, 0.0), walls=((20, 21, -5, 5), (4, 5, 2, 9)), epsilon=3.0)
    path = torch.tensor([[[0.0, 0], [6, 0], [10, 4]],       # free, ends 4 m away
                         [[0.0, 0], [6, 0], [12, 0]],       # free, ends 2 m away
                         [[0.0, 0], [19, 0], [20, 0]],      # both transitions collide, ends 10 m away
                         [[0.0, 3], [8, 3], [10, 1]]])      # one collides, ends 1 m away
    assert s4.planning_reward(path, c).tolist() == [-4, -2, -210, -101]
    assert s4.planning_reward(path, replace(c, reward="sparse")).tolist() == [0, 5, -200, -95]


@pytest.mark.parametrize("reward", ["dense", "sparse"])
def test_plan_is_algorithm_2_in_plain_loops(s4, out, lively, reward):
    c, _ = only(s4, out, reward=reward, samples=200)
    z, delta = pool = s4.skill_pool(c, lively)
    start = torch.tensor([21.0, 6.0])
    torch.manual_seed(5)
    first, path = s4.plan(c, lively, pool, 2, start)
    torch.manual_seed(5)
    best, picked = -1e9, torch.randint(256, (200, 2))
    for sequence in picked:
        state, states = start, [start]
        for skill in sequence:
            for step in delta[skill]:
                state = state + 0.1 * 40 * step
                states.append(state)
        r = -float((state - torch.tensor(c.goal)).norm())
        if reward == "sparse":
            r = 5.0 * (abs(r) < 5)
        for a, b in zip(states, states[1:]):
            r -= 100.0 * float(s4.collides(torch.stack([a, b])[None], c.walls, 1.0).any())
        if r > best + 1e-4:  # of equal ones the first
            best, best_path, best_z = r, torch.stack(states), z[sequence[0]]
    torch.testing.assert_close(first, best_z)
    torch.testing.assert_close(path, best_path, atol=1e-4, rtol=1e-5)
    assert path.untyped_storage().nbytes() == path.numel() * 4  # no view that keeps all N in memory


def test_each_mode_is_one_step_from_the_last(s4, out, monkeypatch):
    """printed and commands are executed alike; commands and closed are predicted alike (above)."""
    asked, execute = [], s4.execute
    monkeypatch.setattr(s4, "execute", lambda p, robots, commands, hold, closed, deterministic: asked.append(
        (commands.shape, hold, closed, deterministic)) or execute(p, robots, commands, hold, closed, deterministic))
    for mode in MODES:
        c, policy = only(s4, out, mode=mode, trials=2, samples=3, hold=4, episode=59)
        s4.plan_and_execute(c, policy)
    assert asked == [((2, 5, 2), 4, False, False)] * 4 + [((2, 5, 2), 4, True, True)] * 2


@pytest.mark.parametrize("mode", MODES)
def test_a_run_is_plans_and_what_they_command(s4, out, mode):
    c, policy = only(s4, out, mode=mode, trials=2, samples=3, hold=4, episode=79, planned=2)
    pool = s4.skill_pool(c, policy)
    poses, plans = s4.plan_and_execute(c, policy)
    assert poses.shape == (61, 2, 15) and np.abs(poses[0, :, :2]).max() < 0.11  # the Ant starts at the origin
    assert [paths.shape for _, paths in plans] == [(2, 11, 2), (2, 11, 2), (2, 6, 2)]  # H_P 2, 2, 1 of three skills
    for k, (z, paths) in enumerate(plans):
        np.testing.assert_allclose(paths[:, 0], poses[20 * k, :, :2], atol=1e-5)  # a plan starts where the robot is
        for n in range(2):
            row = int((pool[0] == z[n]).all(1).nonzero()[0, 0])
            predicted = poses[20 * k, n, :2] + 0.1 * 4 * pool[1][row].sum(0).numpy()  # scale, H_z
            np.testing.assert_allclose(paths[n, 5], predicted, atol=1e-4)
    again, _ = s4.plan_and_execute(c, policy)
    np.testing.assert_array_equal(again, poses)


def test_horizons_are_those_of_table_2_and_end_with_the_episode(s4, out, monkeypatch):
    asked, plan = [], s4.plan
    monkeypatch.setattr(s4, "plan", lambda c, policy, pool, horizon, s0: asked.append(horizon) or plan(c, policy, pool, horizon, s0))
    for reward, horizons in (("dense", [4, 4, 4, 4, 3, 2, 1]), ("sparse", [7, 6, 5, 4, 3, 2, 1])):
        (c, policy, _), = runs(s4, out, method="wedis_s", mazes="maze1", modes="printed", rewards=reward, samples=2, trials=1,
                               hold=4, episode=28, pool=64)
        s4.plan_and_execute(c, policy)
        assert asked == horizons
        asked.clear()


def test_each_policy_has_its_own_starts_and_plans_and_its_methods_share_the_starts(s4, out):
    def start_and_skills(**flags):
        flags = dict(mazes="maze1", modes="printed", rewards="dense", samples=5, hold=1, episode=20, pool=64, trials=2) | flags
        (c, policy, _), = runs(s4, out, **flags)
        poses, plans = s4.plan_and_execute(c, policy)
        of_plans = torch.initial_seed()
        return poses[0], s4.skill_pool(c, policy)[0], of_plans
    start, skills, plans = start_and_skills()
    assert (start[0] != start[1]).any()  # trials differ
    for flags in (dict(method="wedis_nts"), dict(mazes="maze2"), dict(modes="closed"), dict(rewards="sparse"), dict(samples=9),
                  dict(trials=3), dict(method="dads", length=1)):
        np.testing.assert_array_equal(start_and_skills(**flags)[0][:2], start, err_msg=str(flags))
    for flags in (dict(policy_seeds=1), dict(seed=1)):
        other = start_and_skills(**flags)
        assert (other[0] != start).any(1).all() and (other[1] != skills).any() and other[2] != plans


# ---------------------------------------------------------------- tables and intervals

def test_table_2_is_the_papers(s4, out):
    """H_E, H_z, T, steps a skill, H_P dense and sparse as printed; ranges as in the text of App. A.1.4."""
    printed = dict(sectar=(600, 1, 40, 40, 4, 15, 1.5), dads=(300, 20, 1, 20, 4, 15, 1.0), wedis_s=(600, 40, 1, 40, 4, 15, 1.5),
                   wedis_nts=(600, 1, 20, 20, 4, 30, 1.5), wedis=(600, 40, 5, 200, 3, 3, 1.5))
    assert set(printed) | {"dads_speed"} == set(s4.METHODS)
    for method, values in printed.items():
        dense, sparse = (only(s4, out, method, reward=reward)[0] for reward in ("dense", "sparse"))
        assert (dense.episode, dense.hold, dense.length, dense.hold * dense.length, dense.planned, sparse.planned,
                dense.z_range) == values, method
    speed, _ = only(s4, out, "dads_speed")
    assert speed.episode % speed.hold == 0 and speed.episode // speed.hold == 15
    s, o = only(s4, out, maze="s_maze")[0], only(s4, out, maze="obstacles")[0]  # the caption of Fig 18
    assert (s.length, s.hold, s.planned, o.length, o.hold, o.planned) == (6, 50, 2, 5, 50, 1)


@pytest.mark.parametrize("policies", [1, 2, 3, 5, 12])
def test_intervals_hold_the_true_mean_in_95_of_100_studies(policies, s4):
    """Policies that differ, and trials that do: of 4000 studies, in how many the interval holds the truth, 7."""
    rng = np.random.default_rng(0)
    own = 7 + (policies > 1) * rng.normal(0, 2, (4000, policies, 1))
    held = [low < 7 < high for low, high in map(s4.interval, own + rng.normal(0, 3, (4000, policies, 20)))]
    assert np.mean(held) == pytest.approx(0.95, abs=0.012)


def test_values_are_grouped_by_policy(s4):
    rows = [dict(maze=maze, policy_seed=str(seed), final_distance=f"{seed}.{trial}")
            for trial in range(3) for seed in (1, 0) for maze in ("a", "b")]
    found = s4.values_of(rows, "final_distance", maze="a")
    assert found.tolist() == [[0.0, 0.1, 0.2], [1.0, 1.1, 1.2]]  # in the order of the seeds
    assert not s4.values_of(rows, "final_distance", maze="c").size


# ---------------------------------------------------------------- rows and flags

def test_flags_win_over_methods_over_mazes_over_experiments_over_the_file(s4, out):
    s4.EXPERIMENTS["drawn"] = dict(TRIALS=7, POOL=99, HOLD=35, MODES="closed")
    s4.MAZE["mine"] = dict(WALLS=[], HOLD=30, LENGTH=4, GOAL=(1, 2), POOL=77)
    s4.METHODS["other"] = dict(HOLD=25, MODES="printed commands")
    def values(**flags):
        return [(c.mode, c.trials, c.pool, c.hold, c.length, c.goal, c.penalty)
                for c, _, _ in runs(s4, out, experiment="drawn", mazes="mine", rewards="dense", **flags)]
    assert values(method="wedis") == [("closed", 7, 77, 30, 4, (1.0, 2.0), 100.0)]
    assert values(method="other") == [(mode, 7, 77, 25, 4, (1.0, 2.0), 100.0) for mode in ("printed", "commands")]
    flags = dict(modes="closed", trials=1, pool=5, hold=10, length=3, goal="3 4", penalty=2)
    assert values(method="other", **flags) == [("closed", 1, 5, 10, 3, (3.0, 4.0), 2.0)]
    assert s4.MAZE["mine"] == dict(WALLS=[], HOLD=30, LENGTH=4, GOAL=(1, 2), POOL=77)  # rows are left as they are


def test_configurations_are_each_method_maze_policy_mode_reward_and_number(s4, out):
    found = [(c.maze, c.policy_seed, c.mode, c.reward, c.samples)
             for c, _, _ in runs(s4, out, policy_seeds="0,1", samples="10,20,10")]
    assert len(found) == len(set(found)) == 2 * 2 * 3 * 2 * 2


@pytest.mark.parametrize("planned, dense", [(1, 1), (3, 3), (99, 3)])
def test_no_plan_looks_beyond_the_episode_and_sparse_ones_to_its_end(s4, out, planned, dense):
    found = {(c.reward, c.planned) for c, _, _ in runs(s4, out, planned=planned)}
    assert found == {("dense", dense), ("sparse", 3)}


@pytest.mark.parametrize("method", ["wedis", "wedis_s", "wedis_nts", "dads", "dads_speed", "sectar"])
def test_each_row_of_methods_runs(s4, stage, method):
    assert method in s4.METHODS and len(s4.METHODS) == 6
    done = stage(method=method, mazes="maze1", draw="fig03 fig08 fig17", episode=40, rewards="sparse", hold=1, trials=1,
                 policy_seeds=0)  # SeCTAR's row has two
    assert done.code == 0, done.err
    expected = dict(wedis=MODES, wedis_s=MODES[:2], wedis_nts=MODES[:2]).get(method, MODES[:1])
    assert [row["mode"] for row in done.rows] == expected


@pytest.mark.parametrize("maze", ["maze1", "maze2", "s_maze", "obstacles", "open"])
def test_each_row_of_mazes_runs(s4, stage, maze):
    assert maze in s4.MAZE and len(s4.MAZE) == 5
    done = stage(mazes=maze, rewards="dense", modes="closed", episode=None, draw="fig06 fig18", trials=1)
    assert done.code == 0, done.err
    row = done.rows[0]
    assert row["look_ahead"] == str(dict(obstacles=250).get(maze, 600))


@pytest.mark.parametrize("experiment", ["mazes", "figure7", "fig18", "matched"])
def test_each_row_of_experiments_runs(s4, stage, experiment, out, policies, monkeypatch):
    assert experiment in s4.EXPERIMENTS and len(s4.EXPERIMENTS) == 4
    flags = dict(mazes="maze2", rewards="dense", trials=1)
    if experiment == "fig18":
        flags = dict(episode=600, trials=1, hold=10)
    if experiment in ("figure7", "matched"):
        flags |= dict(samples="2 4", hold=10, episode=200, length=1)
        found = {(c.method, c.mode, c.policy_seed) for c, _, _ in runs(s4, out, experiment=experiment)}
        wanted = [(method, mode) for method in ("wedis_s", "wedis_nts") for mode in MODES[:2]]
        if experiment == "figure7":
            wanted += [*(("wedis", mode) for mode in MODES), *((method, "printed") for method in ("dads", "dads_speed", "sectar"))]
        shipped = dict(sectar=(0,))  # a row of METHODS overrides one of EXPERIMENTS
        assert found == {(*one, seed) for one in wanted for seed in shipped.get(one[0], (0, 1, 2))}
        assert {c.trials for c, _, _ in runs(s4, out, experiment=experiment)} == {20}
        flags |= dict(policy_seeds=0)
    if experiment == "matched":
        flags |= dict(planned=99)
    monkeypatch.setattr(render, "can_render", lambda: True)
    monkeypatch.setattr(render, "render", lambda model, poses, high, wide: [np.zeros((high, wide, 3), np.uint8) for _ in poses])
    done = stage(experiment=experiment, draw=None, **flags)
    assert done.code == 0, done.err
    assert list(done.rows[0]) == COLUMNS
    names = dict(mazes=["fig03_trajectory_scaling", "fig06_mazes", "fig14_robots", "fig17_more_examples"], figure7=["fig07_planning"],
                 fig18=["fig18_s_maze_obstacles"], matched=[])[experiment]
    assert sorted(path.stem for path in (out / "figures").glob("*.png")) == names
    if experiment in ("figure7", "matched"):
        assert {(row["method"], row["mode"]) for row in done.rows} == set(wanted)
        assert {row["look_ahead"] for row in done.rows} == ({"200"} if experiment == "matched" else {"30", "40"})


def test_a_maze_of_the_readers_own_is_one_row(s4, stage, out):
    s4.MAZE["mine"] = dict(WALLS=[(3, 4, -2, 2)], GOAL=(5, 0))
    done = stage(mazes="mine", draw="fig03 fig06 fig08 fig17 gif")
    assert done.code == 0, done.err
    assert {row["maze"] for row in done.rows} == {"mine"} and "wedis closed, mine dense, N = 4" in done.out
    assert abs(float(done.rows[0]["final_distance"]) - 5) < 6
    assert (out / "figures" / "mine.gif").exists() or "no GIF" in done.out


def test_a_deleted_maze_and_two_methods_draw_what_is_left(s4, stage):
    del s4.MAZE["maze1"]
    done = stage(mazes="maze2", method="wedis dads", draw="fig03 fig06 fig08 fig17", hold=10)
    assert done.code == 0 and "dads printed, maze2 dense, N = 4" in done.out, done.err


def test_fig_7_copes_with_a_method_for_one_reward(s4, stage, out):
    s4.METHODS["mine"] = dict(REWARDS="dense", MODES="printed", SAMPLES="3 7")
    done = stage(mazes="maze1", method="mine wedis", draw="fig07", samples=None, pool=64, hold=10)
    assert done.code == 0, done.err
    assert {row["samples"] for row in done.rows if row["method"] == "mine"} == {"3", "7"}
    assert (out / "figures" / "fig07_planning.png").stat().st_size > 10_000


@pytest.mark.parametrize("name, value", [
    ("GOAL", (24, 12)), ("GOAL", "20 10"), ("PENALTY", 0), ("RADIUS", 0), ("SAMPLES", 1e2), ("SAMPLES", 30), ("SAMPLES", [3, 4]),
    ("EPSILON", 4), ("REWARD_WEIGHT", 0), ("Z_RANGE", 1), ("HOLD", 20.0), ("LENGTH", 1), ("PLANNED", 1),
    ("EPSILON", 0), ("POLICY_SEEDS", 1), ("MODES", "commands"), ("DRAW", ""), ("SEED", 2 ** 62), ("POOL", 1)])
def test_what_a_reader_writes_in_the_file_runs(s4, stage, monkeypatch, name, value):
    monkeypatch.setattr(s4, name, value)
    flags = dict(rewards="dense sparse", mazes="maze1", trials=1) | {name.lower(): None}
    done = stage(**flags)
    assert done.code == 0 and not done.err, done.err


def test_figures_show_the_modes_side_by_side(s4, stage, out, monkeypatch):
    drawn = {}
    monkeypatch.setattr(s4.common, "save_figure", lambda figure, out, name: drawn.update({name: figure}))
    s4.METHODS["few"] = dict(TRIALS=1, MODES="closed", POLICY_SEEDS="1")
    monkeypatch.setattr(s4, "TRIALS", 2)
    done = stage(method="wedis few", mazes="maze1 maze2", trials=None, draw="fig03 fig08 fig17 fig18")
    assert done.code == 0, done.err
    titles = [f"{method} {mode}, {maze}" if mode in modes else "" for method, modes in (("wedis", MODES), ("few", ["closed"]))
              for maze in ("maze1", "maze2") for mode in MODES]
    for name in ("fig08_mpc_examples", "fig17_more_examples", "fig18_s_maze_obstacles"):
        assert [ax.get_title() for ax in drawn[name].axes] == titles
        assert drawn[name].axes[0].get_gridspec().ncols == 3
    path = drawn["fig08_mpc_examples"].axes[0]
    assert len(path.patches) == len(s4.MAZE["maze1"]["WALLS"]) and len(path.lines) == 2 + 2 + 1  # one skill, one trial
    small, scaled = drawn["fig03_trajectory_scaling"].axes  # the first mode's first plan, one skill, and what was executed
    assert [ax.get_title() for ax in (small, scaled)] == ["printed: predicted", "printed: scaled by $H_z$ = 40"]
    assert len(small.lines) == 1 and len(scaled.lines) == 2 and scaled.lines[1].get_xydata().shape == (201, 2)
    planned = drawn["fig17_more_examples"].axes[0].lines[3].get_xydata()  # behind start, goal and error
    for ax, scale in ((small, 40), (scaled, 1)):
        np.testing.assert_allclose(scale * ax.lines[0].get_xydata(), planned - planned[0], atol=1e-5)
    done = stage(mazes="maze1", rewards="dense", draw="fig08")
    assert done.code == 0 and "no fig08_mpc_examples: no trial has the sparse reward" in done.out


def test_goal_and_epsilon_are_flags(stage):
    done = stage(mazes="maze1", goal="3 0.5", epsilon=2)
    assert done.code == 0, done.err
    assert all(float(row["final_distance"]) < 10 for row in done.rows)
    assert all((float(row["final_distance"]) < 2) == (row["success"] == "1") for row in done.rows)


def test_one_skill_is_followed_from_z_to_metres(s4, stage, monkeypatch):
    kept, plan_and_execute = [], s4.plan_and_execute
    monkeypatch.setattr(s4, "plan_and_execute", lambda *given: kept.append(plan_and_execute(*given)) or kept[-1])
    lines = stage(mazes="maze1").out.splitlines()
    first = lines.index("the first skill of trial 0, wedis printed, maze1 dense, N = 4, ant_semi seed 0:")
    poses, [(z, paths)] = kept[0]
    assert lines[first + 1] == "  z: {:.2f} {:.2f} {:.2f}  speed direction curvature".format(*z[0])
    predicted, executed = paths[0, 5], poses[200, 0, :2]
    assert "predicted end ({:.2f}, {:.2f}) m".format(*predicted) in lines[first + 2]
    assert "executed ({:.2f}, {:.2f}) m".format(*executed) in lines[first + 2]
    assert "  z: " in stage(mazes="maze1", method="dads").out  # its axes have no names


def test_an_episode_that_is_no_whole_number_of_skills_is_said_aloud(stage):
    done = stage(mazes="maze1", episode=399)
    assert done.code == 0 and "a skill takes 200 steps, so an episode of 399 ends at 200" in done.out
    assert "ends at" not in stage(mazes="maze1", episode=400).out


# ---------------------------------------------------------------- results that are used again

def test_a_row_is_replaced_by_one_with_the_same_settings_alone(stage):
    flags = dict(mazes="maze1", modes="printed")
    first = stage(**flags, rewards="dense").rows
    both = stage(**flags, rewards="sparse").rows
    assert len(first) == 2 and both[:2] == first and [row["reward"] for row in both] == ["dense"] * 2 + ["sparse"] * 2
    more = stage(**flags, rewards="dense", samples=30).rows
    assert more[:4] == both and [row["samples"] for row in more] == ["4"] * 4 + ["30"] * 2
    again = stage(**flags, rewards="dense")  # made anew, the same numbers
    assert len(again.rows) == 6 and sorted(row["final_distance"] for row in again.rows) == sorted(row["final_distance"] for row in more)
    assert again.out.count(", maze1 dense, N = ") == 1  # only what was asked for is printed


def test_only_what_was_made_with_the_same_settings_is_used_again(s4, stage, out, monkeypatch):
    shown = []
    monkeypatch.setitem(s4.DRAWINGS, "fig07", lambda rows, configurations, examples: shown.append(rows))
    flags = dict(experiment="figure7", method="wedis", mazes="maze1", samples="2 4", rewards="dense", draw=None, hold=4,
                 episode=40)
    first = stage(**flags, policy_seeds="0 1")
    assert first.code == 0 and len(shown[0]) == 3 * 2 * 2 * 2, first.err  # modes, policies, sizes, trials
    again = stage(**flags, policy_seeds="0 1")
    assert again.out.count("(known)") == 12 and again.rows == first.rows and shown[1] == shown[0]
    assert stage(**flags, policy_seeds="0 1 2").out.count("(known)") == 12  # a study that was stopped goes on
    table = out / "results" / "figure7.csv"
    before = common.read_csv(table)
    table.write_text("".join(table.read_text().splitlines(True)[:-1]))
    assert stage(**flags, policy_seeds="0 1 2").out.count("(known)") == 17  # a row is missing: its configuration runs again
    for name in ("settings", "trial", "final_distance"):
        assert sorted(row[name] for row in common.read_csv(table)) == sorted(row[name] for row in before)

    for change in (dict(hold=8), dict(goal="20 0"), dict(trials=1), dict(seed=1), dict(samples="3")):
        changed = stage(**flags | change, policy_seeds="0")
        assert "(known)" not in changed.out, change
        assert {row["settings"] for row in shown[-1]}.isdisjoint(row["settings"] for row in first.rows), change
        assert {row["policy_seed"] for row in shown[-1]} == {"0"}  # another policy is not pooled into the figure
    assert "(known)" in stage(**flags, policy_seeds="0").out
    for name, value in (("FEEDBACK", 0.05), ("CORRECTION", 0.1)):
        monkeypatch.setattr(common, name, value)
        assert "(known)" not in stage(**flags, policy_seeds="0").out, name
    s4.MAZE["maze1"] = dict(WALLS=s4.HULL)
    assert "(known)" not in stage(**flags, policy_seeds="0").out
    assert "(known)" in stage(**flags, policy_seeds="0").out


def test_a_policy_of_another_physics_is_refused(stage, out, monkeypatch):
    monkeypatch.setattr(common, "FRAME_SKIP", 4)
    done = stage()
    assert done.code == 2 and done.err.count("\n") == 1 and "FRAME_SKIP = 5, not 4: set FRAME_SKIP back" in done.err, done.err
    monkeypatch.setattr(common, "FRAME_SKIP", 5)
    path = common.HERE / "robots" / "ant.xml"
    path.write_text(path.read_text() + "<!-- geared -->")
    done = stage()
    assert done.code == 2 and done.err.count("\n") == 1 and "was made with ant.xml = " in done.err, done.err


def test_another_policy_under_the_same_name_is_planned_anew(stage, out):
    flags = dict(experiment="figure7", method="wedis", mazes="maze1", rewards="dense", policy_seeds="0", draw="fig06",
                 samples=4, hold=4, episode=40)
    assert stage(**flags).code == 0
    make_policy(out, "ant_semi", relation=dict(curvature=0.1))
    assert "(known)" not in stage(**flags).out


# ---------------------------------------------------------------- command line

def test_command_line_draws_everything_and_repeats_itself(fork, out):
    flags = ["--out", out, "--trials", 2, "--samples", 20, "--pool", 512, "--episode", 200, "--threads", 1]
    done = fork("04_mpc_maze", *flags)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    rows = common.read_csv(out / "results/mazes.csv")
    for maze, reward in itertools.product(("maze1", "maze2"), ("dense", "sparse")):
        for mode in MODES:
            line, = [line for line in lines if f" s  wedis {mode}, {maze} {reward}, N = 20, ant_semi seed 0: " in line]
            found = [row for row in rows if (row["maze"], row["reward"], row["mode"]) == (maze, reward, mode)]
            distance, success = (np.mean([float(row[name]) for row in found]) for name in ("final_distance", "success"))
            assert len(found) == 2 and line.endswith(f": {distance:.1f} m from the goal, {100 * success:.0f} % within 5 m")
    assert f"using {out / 'policy_ant_semi_seed0.pt'}" in lines
    assert len(rows) == 2 * 2 * 3 * 2 and list(rows[0]) == COLUMNS
    for name in ("fig03_trajectory_scaling", "fig06_mazes", "fig08_mpc_examples", "fig17_more_examples"):
        assert (out / "figures" / f"{name}.png").stat().st_size > 10_000
    for maze in ("maze1", "maze2"):
        if "no GIF" not in done.stdout:
            assert 10_000 < (out / "figures" / f"{maze}.gif").stat().st_size < 1e6
    assert fork("04_mpc_maze", *flags, "--draw", "fig17", "--mazes", "maze2").returncode == 0  # same seed, same numbers
    again = common.read_csv(out / "results/mazes.csv")
    assert again == rows  # maze1 stays


def test_without_a_gl_library_one_line_says_so(out):
    (out / "sitecustomize.py").write_text("import ctypes.util\nctypes.util.find_library = lambda name: None\n")
    done = cli("04_mpc_maze", "--out", out, "--trials", 1, "--samples", 2, "--pool", 64, "--episode", 200, "--draw",
               "fig14 gif", "--threads", 1, PYTHONPATH=str(out))
    assert done.returncode == 0 and done.stdout.count("no Fig 14, no GIF: MuJoCo's renderer finds no GL library") == 1, done.stderr


@pytest.mark.parametrize("flags, line", [
    (dict(method="ppo"), "unknown 'ppo' in --method; allowed: wedis wedis_s wedis_nts dads dads_speed sectar"),
    (dict(mazes="maze9"), "unknown 'maze9' in --mazes; allowed: maze1 maze2 s_maze obstacles"),
    (dict(modes="open"), "unknown 'open' in --modes; allowed: printed commands closed"),
    (dict(rewards="some"), "unknown 'some' in --rewards; allowed: dense sparse"),
    (dict(draw="fig99"), "unknown 'fig99' in --draw; allowed: "), (dict(mazes=""), "unknown '' in --mazes"),
    (dict(samples="10 0"), "--samples is '0', but must be a whole number of at least 1"),
    (dict(samples="10 x"), "--samples is 'x', but must be a whole number"), (dict(samples=""), "--samples is ''"),
    (dict(experiment="drive"), "unknown experiment 'drive'; allowed: mazes figure7 matched fig18"),
    (dict(policy_seeds="-1"), "--policy_seeds is '-1', but must be a whole number of at least 0"),
    (dict(policy_seeds=""), "--policy_seeds is ''"), (dict(trials=0), "--trials is '0', but must be a whole number of at least 1"),
    (dict(penalty="-1e2"), "--penalty is '-1e2', but must be a number of at least 0"),
    (dict(episode=100), "wedis in maze1: an episode of 100 steps is shorter than a skill: --episode 200"),
    (dict(goal="14.5 3"), "wedis in maze1: the wall (14.0, 15.0, -3.5, 18.0) stands on the goal: move one of them"),
    (dict(policy_seeds="7"), "no policy_ant_semi_seed7.pt in "), (dict(samples="1e13"), "this needs"), (dict(pool="1e13"), "this needs"),
    (dict(trials="1e9"), "this needs"), (dict(samples="1e9", hold=1, length=1), "this needs"),
    (dict(policy="half_cheetah"), "wedis printed, maze1 dense, N = 4, half_cheetah seed 0: mazes are for the ant: choose another"),
    (dict(method="dads", length=5, hold=1), "dads printed, maze1 dense, N = 4, ant_dads seed 0: DADS predicts one step: --length 1"),
    *((dict(method=method, modes=mode, hold=1), f"{method} {mode}, maze1 dense, N = 4, ant_{method} seed 0: this mode is for policies of "
       "WEDIS: --modes printed") for method in ("dads", "sectar") for mode in ("commands", "closed"))])
def test_what_makes_no_sense_gets_one_line(stage, flags, line):
    done = stage(**flags)
    assert done.code == 2 and done.err.count("\n") == 1 and done.err.startswith(f"04_mpc_maze.py: {line}"), done.err
    assert not done.rows


@pytest.mark.parametrize("table, row, line", [
    ("MAZE", dict(WALLS=[(1, 0, 0, 1)]), "must be (x0, x1, y0, y1), x0 < x1, y0 < y1"),
    ("MAZE", dict(WALLS=[10, 11, -6, 6]), "a wall is 10, but must be 4 numbers"), ("MAZE", dict(WALLS=7), "WALLS is 7, but must be a list"),
    ("MAZE", dict(WALLS=[(1, 2, "x", 3)]), "but must be a number"),
    ("MAZE", dict(WALLS=[(-1, 0.3, -2, 2)]), "wedis in mine: the wall (-1.0, 0.3, -2.0, 2.0) stands on the start: move one of them"),
    ("MAZE", dict(HOLDS=3), "wedis in mine: HOLDS is no constant"), ("MAZE", dict(GOAL=(1, 2, 3)), "mine: GOAL is (1, 2, 3), but must be 2"),
    ("METHODS", dict(HOLD="x"), "mine in maze1: HOLD is 'x', but must be a whole number"),
    ("METHODS", dict(PLANNED=0), "mine in maze1: PLANNED is 0, but must be a whole number of at least 1"),
    ("METHODS", dict(OUT="x"), "mine in maze1: OUT is no constant")])
def test_rows_that_make_no_sense_get_one_line(s4, stage, table, row, line):
    getattr(s4, table)["mine"] = row
    done = stage(**{dict(MAZE="mazes", METHODS="method")[table]: "mine"})
    assert done.code == 2 and line in done.err and done.err.count("\n") == 1, done.err


def test_a_policy_of_another_method_is_named(stage):
    done = stage(policy="ant_dads", mazes="maze1", modes="printed", length=1)
    assert done.code == 0, done.err
    assert "wedis printed, maze1 dense, N = 4, ant_dads seed 0" in done.out

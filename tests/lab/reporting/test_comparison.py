"""Comparison of groups of runs."""

import csv
import io
import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest

import rejeu
from rejeu.lab.reporting.comparison import compare
from rejeu.lab.reporting.grouping import differing_settings
from rejeu.logs.charts import group_chart


def write_run(folder, algorithm="DQN", env="CartPole-v1", seed=0, level=10.0, steps=1000, every=10, **config):
    """Writes a run whose return rises linearly over the first half and then stays at ``level``."""
    folder.mkdir(parents=True)
    content = {
        "env": env,
        "algorithm": algorithm,
        "seed": seed,
        "hyperparameters": {"gamma": 0.9},
        "steps": steps,
        **config,
    }
    (folder / "config.json").write_text(json.dumps(content), encoding="utf-8")
    step = np.arange(every, steps + 1, every)
    rows = [f"{x},0,{level * min(2 * x / steps, 1.0)},{every},nan,{x / 100}" for x in step.tolist()]
    (folder / "episodes.csv").write_text(
        "\n".join(["step,env,return,length,success,seconds", *rows, ""]), encoding="utf-8"
    )
    (folder / "evaluations.csv").write_text(
        f"step,seconds,success_rate,mean_return\n{steps},9,nan,{level + 1}\n", encoding="utf-8"
    )
    (folder / "agent.safetensors").write_bytes(b"")
    return folder


@pytest.fixture
def runs(tmp_path):
    for algorithm, base in (("DQN", 10.0), ("PPO", 20.0)):
        for seed in range(5):
            write_run(tmp_path / f"{algorithm}_{seed}", algorithm, seed=seed, level=base + seed)
    return tmp_path


def test_two_algorithms(runs):
    comparison = rejeu.compare(runs, samples=200)
    assert comparison.by == "algorithm"
    assert [(group.label, group.env_id, len(group.runs)) for group in comparison.groups] == [
        ("DQN", "CartPole-v1", 5),
        ("PPO", "CartPole-v1", 5),
    ]
    dqn, ppo = comparison.groups
    np.testing.assert_allclose(dqn.scores[0], [10, 11, 12, 13, 14])
    assert dqn.score[0] == pytest.approx(12.0)
    assert 10 <= dqn.score[1] < 12 < dqn.score[2] <= 14
    assert (dqn.mean, dqn.median) == pytest.approx((12.0, 12.0))
    assert dqn.curve[0, -1] == pytest.approx(12.0)
    assert math.isnan(dqn.curve[0, 0])
    (improvement,) = comparison.improvements
    assert (improvement.label, improvement.other, improvement.probability) == ("PPO", "DQN", 1.0)
    assert improvement.cells[3] == "100% (in all 25 pairs of runs)"
    assert comparison.standings == ["", "best"]
    assert comparison.settings == [["setting", "DQN", "PPO"], ["algorithm", "DQN", "PPO"]]
    thin = [series for series in group_chart("curve", comparison)["series"] if series["kind"] == "thin"]
    assert [(series["name"], series["color"], series["y"][-1]) for series in thin][::9] == [
        ("DQN_0", "group0", 10.0),
        ("PPO_4", "group1", 24.0),
    ]
    assert dqn.reached is ppo.reached is None
    assert dqn.profile[0, 0] == pytest.approx(0.8)  # four of five are above the lowest score
    assert comparison.notes == (
        "intervals of few runs are too narrow: those of 5 runs contain the true score in 90 % of cases, not in 95 %",
    )


def test_groups_whose_intervals_meet_may_both_be_best_and_settings_that_differ_are_listed(tmp_path):
    for rate, levels in ((0.1, (10.0, 30.0)), (0.2, (20.0, 28.0)), (0.3, (1.0, 2.0))):
        for seed, level in enumerate(levels):
            hyperparameters = {"gamma": 0.9, "learning_rate": rate, "net": {"width": 8 * seed}}
            write_run(tmp_path / f"{rate}_{seed}", seed=seed, level=level, hyperparameters=hyperparameters)
    comparison = rejeu.compare(tmp_path, "algorithm", samples=50)
    assert (comparison.standings, comparison.settings) == ([""], [])
    runs = [run for group in comparison.groups for run in group.runs]
    by_rate = [[run for run in runs if run.config.hyperparameters["learning_rate"] == rate] for rate in (0.1, 0.2, 0.3)]
    assert differing_settings(by_rate) == [["learning_rate", "0.1", "0.2", "0.3"]]
    assert differing_settings([by_rate[0][:1], by_rate[0][1:]]) == [["net.width", "0", "8"]]
    others = [
        replace(run, config=replace(run.config, hyperparameters={"n_epochs": 4, "gamma": 0.9})) for run in by_rate[0]
    ]
    assert differing_settings([*by_rate[:2], others, others]) == [["learning_rate", "0.1", "0.2", "", ""]]
    by_folder = [replace(run, config=replace(run.config, algorithm=run.name[:3])) for run in runs]
    assert rejeu.compare(by_folder, "algorithm", samples=50).standings == ["may be best", "may be best", ""]


def test_steps_to_the_threshold_are_the_median_of_the_runs(tmp_path):
    for seed, level in enumerate((10.0, 20.0)):
        write_run(tmp_path / str(seed), seed=seed, level=level)
    # the mean of the last 50 steps is the return 20 steps before, and curves have a point each 10 steps
    for folder, expected in ((tmp_path / "0", 470.0), (tmp_path / "1", 250.0)):
        assert compare(folder, threshold=8.9, samples=10).groups[0].reached == (1, expected)
        assert compare(folder, x="time", threshold=8.9, samples=10).groups[0].reached[1] == pytest.approx(
            expected / 100
        )
    assert compare(tmp_path, threshold=8.9, samples=10).groups[0].reached == (2, 360.0)
    assert compare(tmp_path, threshold=15.0, samples=10).groups[0].reached == (1, math.inf)


def test_curve_is_a_moving_mean_of_the_returns(tmp_path):
    run = write_run(tmp_path / "run")
    (group,) = compare([run], samples=10).groups
    step = np.arange(10, 1001, 10)
    returns = 10 * np.minimum(2 * step / 1000, 1)
    for x, value in zip(group.x[2:], group.curve[0, 2:], strict=True):
        assert value == pytest.approx(returns[(step > x - 50) & (step <= x)].mean())


def test_final_score_by_evaluation_and_over_time(runs):
    comparison = compare(runs, score="evaluation", samples=50)
    np.testing.assert_allclose(comparison.groups[0].scores[0], [11, 12, 13, 14, 15])
    assert "last evaluation" in comparison.definition
    assert compare(runs, x="time", samples=10).groups[0].x[-1] == 10.0


def test_last_evaluation_counts_though_the_last_episode_ended_before_it(tmp_path):
    folder = write_run(tmp_path / "run")
    lines = (folder / "episodes.csv").read_text(encoding="utf-8").splitlines()
    (folder / "episodes.csv").write_text("\n".join([*lines[:-3], ""]), encoding="utf-8")
    rows = ["step,seconds,success_rate,mean_return", "500,5,nan,1", "1000,10,nan,2", ""]
    (folder / "evaluations.csv").write_text("\n".join(rows), encoding="utf-8")
    for axis, end in (("steps", 1000), ("time", 10)):
        (group,) = compare(folder, x=axis, score="evaluation", samples=10).groups
        assert (group.score[0], group.x[-1]) == (2.0, end)


def test_different_budgets_are_cut_to_the_shortest_and_runs_without_an_evaluation_before_it_are_left_out(tmp_path):
    write_run(tmp_path / "a", seed=0)
    write_run(tmp_path / "b", seed=1, steps=500)
    comparison = compare(tmp_path, samples=10)
    assert comparison.groups[0].x[-1] == 500
    assert comparison.notes[0] == (
        "the runs on CartPole-v1 have between 500 and 1,000 steps; all are compared up to those of b (finished)"
    )
    comparison = compare(tmp_path, score="evaluation", samples=10)
    assert [run.name for run in comparison.groups[0].runs] == ["b"]
    assert "a has no evaluation within what is compared and is left out" in comparison.notes


def test_absurd_returns_are_damage(tmp_path):
    folder = write_run(tmp_path / "run")
    with (folder / "episodes.csv").open("a", encoding="utf-8") as file:
        file.write("1000,0,1e200,10,nan,10\n")
    assert compare(folder, samples=10).groups[0].score[0] == 10


def test_time_that_was_set_back_is_sorted(tmp_path):
    folder = write_run(tmp_path / "run", steps=40)
    rows = ["step,env,return,length,success,seconds", "10,0,1,10,,3", "20,0,2,10,,1", "30,0,3,10,,2", "40,0,4,10,,10"]
    (folder / "episodes.csv").write_text("\n".join([*rows, ""]), encoding="utf-8")
    (group,) = compare(folder, x="time", samples=10).groups
    assert group.curve[0, [11, 21, 31, 100]].tolist() == [2, 3, 1, 4]


def test_groups_by_the_settings_that_differ_within_an_algorithm_and_a_note_where_they_are_mixed(tmp_path):
    for i, gamma in enumerate((0.9, 0.9, 0.99)):
        write_run(tmp_path / f"dqn{i}", seed=i, hyperparameters={"gamma": gamma, "tau": 1.0})
    comparison = compare(tmp_path, samples=10)
    assert comparison.by == "setting"
    groups = [("DQN, gamma=0.9", 2), ("DQN, gamma=0.99", 1)]
    assert [(group.label, len(group.runs)) for group in comparison.groups] == groups
    assert "1 of 2 groups have one run" in comparison.notes[0]
    assert f"<p>note: {comparison.notes[0]}</p>" in comparison._repr_html_()
    for i in range(3):
        write_run(tmp_path / f"ppo{i}", "PPO", seed=i, hyperparameters={"gamma": 0.9, "n_epochs": 4})
    comparison = compare(tmp_path, "setting", samples=10)
    assert [(group.label, len(group.runs)) for group in comparison.groups] == [*groups, ("PPO", 3)]
    assert compare(tmp_path, samples=10).notes == (
        "DQN: the runs of this group differ in their settings; group by setting to separate them",
        "intervals of few runs are too narrow: those of 3 runs contain the true score in 75 % of cases, not in 95 %",
    )


def test_settings_that_differ_between_environments_are_no_groups_by_default(tmp_path):
    for env, gamma in (("A-v0", 0.9), ("B-v0", 0.99)):
        write_run(tmp_path / env, env=env, hyperparameters={"gamma": gamma})
    assert compare(tmp_path, samples=10).by == "env"
    write_run(tmp_path / "more", env="B-v0", hyperparameters={"gamma": 0.9})
    assert compare(tmp_path, samples=10).by == "setting"


def test_settings_whose_labels_begin_alike_are_different_groups(tmp_path):
    for i, (last, x) in enumerate(itertools.product((0.1, 0.2), (0, 1))):
        noise = {"noise": "normal", "mean": [0.0] * 100, "sigma": [0.0] * 100 + [last]}
        write_run(tmp_path / str(i), seed=i, hyperparameters={"action_noise": noise}, env_kwargs={"x": [0] * 90 + [x]})
    comparison = compare(tmp_path, "setting", samples=10)
    assert len({group.label for group in comparison.groups}) == 2
    assert len({group.env_id for group in comparison.groups}) == 2
    assert max(len(group.label) for group in comparison.groups) < 220


def test_runs_of_the_same_seed_get_a_note(tmp_path):
    for i, (algorithm, seed) in enumerate((("DQN", 0), ("DQN", 0), ("PPO", 0), ("PPO", 1))):
        write_run(tmp_path / str(i), algorithm, seed=seed)
    note = "DQN: runs of this group have the same seed; they count as several, but are not independent"
    assert compare(tmp_path, samples=10).notes[0] == note
    others = compare([tmp_path / "1", tmp_path / "2"], "env", samples=10)  # of two algorithms
    assert len(others.groups[0].runs) == 2
    assert not any("same seed" in one for one in others.notes)


def test_runs_of_the_same_name_get_that_of_the_folder_above(tmp_path):
    for parent in ("a", "b"):
        write_run(tmp_path / parent / "seed_0")
    (tmp_path / "b" / "seed_0" / "episodes.csv").unlink()
    comparison = compare(tmp_path, samples=10)
    assert "b/seed_0 has no episode yet and is left out" in comparison.notes
    assert comparison.groups[0].runs[0].name == "a/seed_0"


def test_several_environments_are_not_averaged_unless_normalized(tmp_path):
    for env, level in (("A-v0", 1.0), ("B-v0", 1000.0)):
        for algorithm, factor in (("DQN", 1.0), ("PPO", 2.0)):
            for seed in range(2):
                write_run(tmp_path / f"{env}{algorithm}{seed}", algorithm, env, seed, level * factor)
    apart = compare(tmp_path, "algorithm", samples=20)
    assert [(group.label, group.env_id) for group in apart.groups] == [
        ("DQN", "A-v0"),
        ("PPO", "A-v0"),
        ("DQN", "B-v0"),
        ("PPO", "B-v0"),
    ]
    assert "their returns cannot be averaged" in apart.notes[0]
    together = compare(tmp_path, "algorithm", normalize="range", samples=20)
    assert [(group.label, group.score[0]) for group in together.groups] == [("DQN", 0.0), ("PPO", 1.0)]
    references = {"A-v0": (0.0, 2.0), "B-v0": (0.0, 4000.0)}
    scaled = compare(tmp_path, "algorithm", normalize=references, samples=20)
    assert [group.mean for group in scaled.groups] == pytest.approx([0.375, 0.75])
    with pytest.raises(ValueError, match="has no reference returns for 'B-v0'"):
        compare(tmp_path, normalize={"A-v0": (0.0, 2.0)})


def test_groups_of_different_environments_are_not_compared(tmp_path):
    for algorithm, envs in (("DQN", "AB"), ("PPO", "AC"), ("A2C", "AB")):
        for env in envs:
            for seed in range(5):
                write_run(tmp_path / f"{algorithm}{env}{seed}", algorithm, f"{env}-v0", seed, 1.0 + seed)
    comparison = compare(tmp_path, "algorithm", normalize="range", samples=20)
    assert {(group.label, group.env_id) for group in comparison.groups} == {
        ("DQN", "A-v0, B-v0"),
        ("PPO", "A-v0, C-v0"),
        ("A2C", "A-v0, B-v0"),
    }
    (improvement,) = comparison.improvements
    assert {improvement.label, improvement.other} == {"A2C", "DQN"}
    assert improvement.env_id == "A-v0, B-v0"
    assert comparison.notes[0] == (
        "the groups are of different environments; only groups of the same environments are compared"
    )


def test_runs_without_episodes_are_left_out(runs):
    folder = write_run(runs / "crashed", seed=9)
    (folder / "episodes.csv").unlink()
    comparison = compare(runs, samples=10)
    assert comparison.notes[0] == "crashed has no episode yet and is left out"
    assert sum(len(group.runs) for group in comparison.groups) == 10
    with pytest.raises(ValueError, match="there is nothing to compare; crashed has no episode yet"):
        compare(folder)


def test_where_runs_of_full_length_have_no_episode_no_group_is_called_best(runs):
    """The runs left have the scores of episodes that ended early, which says nothing about their group."""
    for i in range(3):
        (runs / f"PPO_{i}" / "episodes.csv").unlink()
    comparison = compare(runs, samples=10)
    assert [len(group.runs) for group in comparison.groups] == [5, 2]
    assert (comparison.standings, comparison.improvements) == (["", ""], ())
    assert comparison.notes[:2] == (
        "3 runs on CartPole-v1 (3 PPO) have no episode yet and are left out: PPO_0, PPO_1, PPO_2",
        "no group on CartPole-v1 is called best, because runs that trained as long have ended no episode; the score by "
        "evaluation includes those that were evaluated",
    )


def test_a_run_that_has_just_begun_takes_no_place_from_others(runs):
    begun = write_run(runs / "begun", seed=9, steps=100)
    (begun / "episodes.csv").unlink()
    comparison = compare(runs, samples=10)
    assert comparison.standings == ["", "best"]
    assert len(comparison.improvements) == 1


def test_score_by_evaluation_includes_runs_of_which_no_training_episode_has_ended(runs):
    for i in range(3):
        (runs / f"PPO_{i}" / "episodes.csv").unlink()
    comparison = compare(runs, score="evaluation", samples=10)
    np.testing.assert_allclose(comparison.groups[1].scores[0], [21, 22, 23, 24, 25])
    assert comparison.standings == ["", "best"]


def test_labels_name_no_setting_that_only_other_environments_have(tmp_path):
    for env, gamma in (("A-v0", 0.9), ("B-v0", 0.99)):
        for rate in (0.1, 0.2):
            hyperparameters = {"gamma": gamma, "learning_rate": rate}
            write_run(tmp_path / f"{env}{rate}", env=env, hyperparameters=hyperparameters)
    labels = [group.label for group in compare(tmp_path, "setting", samples=10).groups]
    assert labels == 2 * ["DQN, learning_rate=0.1", "DQN, learning_rate=0.2"]


@pytest.mark.parametrize("score", ["training", "evaluation"])
def test_offline_runs_are_compared_by_their_evaluations(tmp_path, score):
    for seed in range(2):
        folder = write_run(tmp_path / str(seed), "IQL", seed=seed, level=seed, hyperparameters={"offline": True})
        (folder / "episodes.csv").unlink()
    (group,) = compare(tmp_path, score=score, samples=10).groups
    assert group.scores[0].tolist() == [1.0, 2.0]


def test_run_in_progress_is_compared_by_its_means(tmp_path):
    folder = write_run(tmp_path / "run")
    (folder / "episodes.csv").unlink()
    (folder / "metrics.csv").write_text("step,rollout/ep_rew_mean,time/seconds\n500,3,1\n1000,5,2\n", encoding="utf-8")
    comparison = compare(folder, samples=10)
    assert comparison.groups[0].score[0] == 5.0
    assert comparison.notes[0] == (
        "1 of 1 runs have no episodes on disk; the logged means of their latest episodes are used, or else their "
        "evaluations"
    )


def test_outputs(runs, tmp_path):
    assert (
        "steps to" not in compare(runs, samples=20).to_markdown()
    )  # every group reaches a threshold made from its own scores
    comparison = compare(runs, threshold=12, samples=20)
    table = list(csv.DictReader(io.StringIO(comparison.to_csv())))
    assert [[*row.values()][:3] for row in table] == [["DQN", "CartPole-v1", "5"], ["PPO", "CartPole-v1", "5"]]
    assert [*table[0]][3:] == [
        "iqm",
        "iqm_low",
        "iqm_high",
        "mean",
        "median",
        "threshold",
        "reached",
        "steps_to_threshold",
    ]
    dqn = comparison.groups[0]
    expected = [*dqn.score, dqn.mean, dqn.median, 12, *dqn.reached]
    assert [float(one) for one in [*table[0].values()][3:]] == expected
    assert dqn.score[1] < dqn.score[0] < dqn.score[2]
    assert "| DQN | CartPole-v1 | 5 |" in comparison.to_markdown()
    assert "steps to 12" in comparison.to_markdown()
    assert "(5 of 5)" in comparison.to_markdown()
    content = json.loads(comparison.to_json())
    curve = content["groups"][0]["curve"]
    assert curve["value"][0] is None
    rows = list(csv.DictReader(io.StringIO(comparison.curves_csv())))
    assert len(rows) == 202
    for i in (50, 100):
        point = [curve[name][i] for name in ("x", "value", "low", "high")]
        assert point == [float(rows[i][name]) for name in ("steps", "value", "low", "high")]
        assert point == [10.0 * i, *dqn.curve[:, i]]
        assert point[2] < point[1] < point[3]
    assert "final score" in repr(comparison)
    (path,) = comparison.save(tmp_path / "out" / "table.md")
    assert path.read_text(encoding="utf-8") == comparison.to_markdown()
    with pytest.raises(ValueError, match=r"'a\.txt' must end in md, csv"):
        comparison.save(tmp_path / "a.txt")


HOSTILE = "<script>alert(1)</script>|=cmd()$x_{$"


def test_hostile_names_are_escaped(tmp_path):
    for seed, algorithm in enumerate((HOSTILE, "=1+1")):
        write_run(tmp_path / str(seed), algorithm, env=HOSTILE, seed=seed)
    comparison = compare(tmp_path, samples=10)
    assert "<script" not in comparison._repr_html_()
    assert "<script" not in comparison.to_markdown().replace("\\<", "")
    assert "'=1+1" in comparison.to_csv()
    pytest.importorskip("matplotlib")
    comparison.plot(tmp_path / "a.png")


@pytest.mark.parametrize(
    "arguments",
    [
        {"by": "seed"},
        {"x": "epochs"},
        {"score": "best"},
        {"statistic": "mode"},
        {"samples": 0},
        {"seed": -1},
        {"threshold": math.nan},
        {"normalize": {"CartPole-v1": 3}},
        {"normalize": {"CartPole-v1": (0, "x")}},
    ],
)
def test_invalid_arguments(runs, arguments):
    with pytest.raises(ValueError, match="must be"):
        compare(runs, **arguments)


def test_equal_scores_are_one_step_of_the_profile(tmp_path):
    for seed in range(3):
        write_run(tmp_path / str(seed), "DQN", seed=seed, level=10.0)
    (group,) = rejeu.compare(tmp_path, samples=50).groups
    np.testing.assert_allclose([group.levels[0], group.levels[-1]], [9, 11])
    assert [group.profile[0, 0], group.profile[0, -1]] == [1, 0]

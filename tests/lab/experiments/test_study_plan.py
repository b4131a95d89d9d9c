"""Plans of studies: what they take from presets, what is refused, and files that are damaged or hostile."""

import dataclasses
import json

import pytest

from rejeu.agents import presets
from rejeu.algorithms.search import Integers, LogUniform
from rejeu.core.errors import CheckpointError
from rejeu.core.records import json_text
from rejeu.lab.experiments import study_plan as plans


def test_a_plan_takes_what_is_not_said_from_the_preset():
    plan = plans.make("Pendulum-v1")
    one = plan.default
    assert (one.algorithm, one.total_steps, one.n_envs, one.backend) == ("SAC", 20_000, 1, "envpool")
    assert (one.evaluate_every, one.evaluate_episodes) == (2_000, 20)
    values = {"learning_rate": 1e-3, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}
    assert plan.fixed == one.hyperparameters == values


def test_trials_count_successes_as_runs_of_the_preset_do():
    plan = plans.make("Acrobot-v1", preset=presets.named("Rainbow", "Acrobot-v1"))
    default = dataclasses.replace(plan.default, success_threshold=-90.0)
    preset = dataclasses.replace(plan, default=default).preset({"gamma": 0.5}, "a test")
    assert (preset.success_threshold, preset.name) == (-90.0, "")


def test_without_a_preset_the_algorithm_is_named_and_its_defaults_are_compared_with():
    with pytest.raises(ValueError, match="Blackjack-v1 has no preset; name the algorithm to tune, such as --algo PPO"):
        plans.make("Blackjack-v1")
    plan = plans.make("Blackjack-v1", "ppo")
    default = plan.default
    assert (default.algorithm, default.hyperparameters, default.total_steps) == ("PPO", {}, 100_000)


def test_an_environment_in_jax_is_tuned_on_its_own_backend(tmp_path):
    plan = plans.make("jax/CartPole-v1", "PPO")
    assert plan.default.backend == "jax"
    path = presets.write(plan.preset({}, "a test"), tmp_path / "preset.json")
    assert presets.read(path).backend == "jax"


def test_what_is_set_is_not_searched():
    plan = plans.make("Pendulum-v1", fixed={"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}})
    assert not {"gamma", "policy_kwargs.net_arch"} & plan.space.keys()
    assert plan.fixed["gamma"] == 0.9
    plan = plans.make("CartPole-v1", "PPO", fixed={"policy_kwargs": {"net_arch": [8]}})
    assert "policy_kwargs.activation_fn" in plan.space


def test_hindsight_is_searched_where_it_is_used():
    assert plans.make("parking-v0").search_space["replay_buffer_kwargs.n_sampled_goal"] == Integers(1, 5)


def test_the_first_trial_may_have_the_choices_of_the_default():
    mix = {"future": 2, "desired": 2}
    fetch = presets.find("FetchPickAndPlace-v4")
    for preset, name, value in (
        (fetch, "replay_buffer_kwargs.goal_selection_strategy", mix),
        (fetch, "policy_kwargs.net_arch", [128, 128, 128]),
        (presets.find("CartPole-v1", "PPO"), "clip_range", 0.2),  # the start of a schedule, which is a choice already
    ):
        space = plans.make(preset.env_id, preset=preset).search_space
        assert value in space[name].values
        assert space[name].values.count(value) == 1


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"algorithm": "SACK"}, ValueError, "no algorithm is called 'SACK'; did you mean SAC?"),
        ({"only": ("gama",)}, ValueError, "the search space of SAC has no setting 'gama'; did you mean gamma?"),
        ({"search": {"gama": LogUniform(0.1, 0.9)}}, TypeError, "SAC has no setting 'gama'; did you mean gamma?"),
        (
            {"search": {"tau": LogUniform(0.1, 9.0)}},
            ValueError,
            "tau=9.0 must be a finite number, at least 0 and at most 1",
        ),
        ({"fixed": {"lr": 1}}, TypeError, "the step size is called learning_rate"),
        ({"final_seeds": 2}, ValueError, "final_seeds=2 cannot tell luck from a difference; give 5 or more, or 0"),
        ({"trial_seeds": 0}, ValueError, "trial_seeds=0"),
        ({"pruner": "hyperband"}, ValueError, "pruner='hyperband'"),
        (
            {"fixed": {"policy_kwargs": {"net_arch": [8]}}, "only": ("policy_kwargs.net_arch",)},
            ValueError,
            "has no setting",
        ),
    ],
)
def test_mistakes_are_reported_before_anything_starts(changes, error, message):
    with pytest.raises(error) as found:
        plans.make("Pendulum-v1", **changes)
    assert message in str(found.value)


def test_seeds_are_derived_from_one_seed_and_those_of_the_comparison_are_fresh():
    plan = plans.make("Pendulum-v1", trial_seeds=3, final_seeds=5, seed=1)
    assert plan.seeds(0) == plan.seeds(0) != plan.seeds(1)
    assert len({*plan.fresh_seeds()}) == 5
    assert all(seed % 2 == 0 for index in range(50) for seed in plan.seeds(index))
    assert all(seed % 2 == 1 for seed in plan.fresh_seeds())
    assert dataclasses.replace(plan, seed=2).fresh_seeds() != plan.fresh_seeds()


def test_what_is_written_is_read(tmp_path):
    plan = plans.make("CartPole-v1", "PPO")
    (tmp_path / "study.json").write_text(json_text(plan))
    assert plans.read(tmp_path / "study.json") == plan
    assert plans.difference(plan, dataclasses.replace(plan, trials=99)) == ""
    assert plans.difference(plan, dataclasses.replace(plan, seed=9)) == "another study: seed is 0 there, not 9"


@pytest.mark.parametrize(
    "change",
    [
        {"default": {"algorithm": "os"}},
        {"default": {"env_id": ""}},
        {"trials": 10**9},
        {"space": {"gamma": "uniform:1..0"}},
        {"space": {"gamma": "os:0..1"}},
        {"space": {"unknown": "uniform:0..1"}},
        {"final_seeds": 3},
        {"space": {"gamma": 3}},
        {"fixed": {"policy_kwargs": 3}},
        {"default": {"backend": "evil"}},
    ],
)
def test_a_damaged_file_is_one_line(tmp_path, change):
    path = tmp_path / "study.json"
    content = json.loads(json_text(plans.make("Pendulum-v1")))
    content |= change | {"default": {**content["default"], **change.get("default", {})}}
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"study\.json is damaged: ") as error:
        plans.read(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[]", b"{}", b"{" * 10_000, b" " * (plans.MAX_BYTES + 1)])
def test_a_file_of_something_else_is_one_line(tmp_path, content):
    path = tmp_path / "study.json"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"study\.json is damaged: "):
        plans.read(path)

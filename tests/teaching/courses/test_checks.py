"""The checks accept right answers, and name the mistake in typical wrong ones, in both languages."""

import string

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.teaching.courses import checks
from rejeu.teaching.courses.checks import box, dqn_ppo, goals, imitation
from tests.bit_flipping import BitFlipping
from tests.teaching.courses import box_answers, dqn_ppo_answers, goals_answers, imitation_answers
from tests.tiers import only

COURSES = ((dqn_ppo, dqn_ppo_answers), (box, box_answers), (goals, goals_answers), (imitation, imitation_answers))
RIGHT = [(check, answer) for check, answers in COURSES for answer in answers.RIGHT]
WRONG = [(getattr(check, name), wrong, message) for check, all_of in COURSES for name, wrong, message in all_of.WRONG]
EACH_RIGHT = pytest.mark.parametrize(
    ("check", "answer"), RIGHT, ids=[f"{check.__name__[21:]}.{answer.__name__}" for check, answer in RIGHT]
)


@pytest.fixture(autouse=True)
def notebook(monkeypatch):
    """Sets what a notebook has: a language, and JAX's own rule for broadcasting."""
    monkeypatch.setenv("REJEU_LANGUAGE", "en")  # restored at the end
    checks.speak("en")
    with jax.numpy_rank_promotion("allow"):
        yield


def check_of(check, answer):
    return check.replay_memory if answer.__name__ == "ReplayMemory" else getattr(check, answer.__name__)


@EACH_RIGHT
def test_a_right_answer_passes(check, answer, capsys):
    assert check_of(check, answer)(answer)
    assert capsys.readouterr().out == f"OK - {check_of(check, answer).__name__}\n"


@EACH_RIGHT
@pytest.mark.parametrize("language", only(["en"], ["en", "fr"]))
def test_unfilled_exercises_and_errors_give_one_line(check, answer, language, capsys):
    checks.speak(language)

    def broken(*_):
        return undefined_name + 1  # noqa: F821

    for wrong in (lambda *_: None, lambda *_: "x", lambda *_: ..., ..., 3, broken):
        assert not check_of(check, answer)(wrong)
        out = capsys.readouterr().out
        assert len(out.splitlines()) == 1
        assert out.startswith({"en": "Not yet - ", "fr": "Pas encore - "}[language])
        assert "...." not in out  # the three dots of the exercise and a full stop
    assert "NameError: name 'undefined_name' is not defined" in out
    assert "return undefined_name + 1" in out


@pytest.mark.parametrize(("check", "wrong", "message"), WRONG, ids=[f"{c.__name__}-{m}" for c, _, m in WRONG])
def test_a_typical_mistake_is_named(check, wrong, message, capsys):
    assert not check(wrong)
    english = capsys.readouterr().out
    assert message in english
    checks.speak("fr")
    assert not check(wrong)
    french = capsys.readouterr().out
    assert french.startswith("Pas encore - ")
    assert len(english.splitlines()) == len(french.splitlines()) == 1


@pytest.mark.parametrize("course", ["base", "dqn_ppo", "box", "goals"])
def test_messages_are_in_both_languages_with_the_same_values(course):
    for exercise in checks.messages(course).values():
        for name, message in exercise.items():
            if name in ("case", "where", "right", "each", "compiles", "gradient"):
                continue
            assert message.keys() - {"result"} == {"en", "fr"}
            texts = (message["en"], message["fr"])
            fields = [{part[1] for part in string.Formatter().parse(text) if part[1]} for text in texts]
            assert fields[0] == fields[1] or course == "base"


@pytest.mark.parametrize(
    ("check", "answers"),
    [(goals.future, [lambda *_: [[1], [1, 2]]]), (goals.steps_needed, [10**400]), (goals.saving, [None, None, 3])],
)
def test_an_answer_of_another_kind_gives_one_line(check, answers, capsys):
    assert not check(*answers)
    printed = capsys.readouterr().out
    assert "the check cannot use your answer (" in printed
    assert printed.count("\n") == 1


def test_other_right_answers_pass():
    assert dqn_ppo.replay_memory(dqn_ppo_answers.WithoutReplacement)
    assert goals.steps_needed(4096)
    assert not goals.steps_needed(12)


def test_a_cell_that_lacks_an_answer_stops_with_one_line():
    dqn_ppo.ratio(lambda new, old: new - old)
    dqn_ppo.epsilon(dqn_ppo_answers.right.epsilon)
    checks.require("epsilon", number=3)
    with pytest.raises(Exception, match="needs your ratio, choose, agent") as raised:
        checks.require("epsilon", "ratio", "choose", agent=...)
    assert raised.value._render_traceback_() == [str(raised.value)]


def test_a_wrong_answer_after_a_right_one_counts():
    dqn_ppo.ratio(dqn_ppo_answers.right.ratio)
    dqn_ppo.ratio(None)
    with pytest.raises(Exception, match="needs your ratio"):
        checks.require("ratio")


def save_all(agent, folder):
    agent.save(folder / "model")
    agent.save_replay_buffer(folder / "buffer")


def load_all(folder, env):
    agent = rejeu.DQN.load(folder / "model", env=env)
    agent.load_replay_buffer(folder / "buffer")
    return agent


def test_saving_needs_the_model_and_the_buffer(capsys):
    def make(seed=0):
        return rejeu.DQN("MultiInputPolicy", BitFlipping(4), replay_buffer_class="HerReplayBuffer", seed=seed)

    agent = make()
    agent.learn(20)
    wrong = [
        (save_all, lambda folder, env: rejeu.DQN.load(folder / "model", env=env), "holds 0 steps instead of 20"),
        (save_all, lambda folder, env: agent, "not one from the files"),
        (save_all, lambda folder, env: make(seed=1), "acts differently"),
        (lambda agent, folder: None, load_all, "FileNotFoundError"),
        (save_all, lambda folder, env: env, "instead of a DQN"),
    ]
    for save, load, message in wrong:
        assert not goals.saving(save, load, agent, BitFlipping(4))
        out = capsys.readouterr().out
        assert message in out
        assert len(out.splitlines()) == 1
    assert goals.saving(save_all, load_all, agent, BitFlipping(4))


def test_the_reward_of_parking_is_that_of_the_environment():
    pytest.importorskip("highway_env")
    env = gym.make("parking-v0").unwrapped
    obs, _ = env.reset(seed=0)
    given = obs["achieved_goal"], obs["desired_goal"]
    weights = np.array([1.0, 0.3, 0.0, 0.0, 0.02, 0.02])
    ours = goals_answers.right.parking_reward(*(goal[None] for goal in given), weights)
    assert ours[0] == pytest.approx(float(env.compute_reward(*given, {})))

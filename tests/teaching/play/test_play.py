"""Playing by hand and watching, in a window on SDL's dummy driver, with key events in SDL's own queue."""

import re
import sys
import time
import warnings

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.core.language import said
from rejeu.envs.registry import make_env
from rejeu.lab.cli import main
from rejeu.teaching.play import Game, play, watch
from rejeu.teaching.play.game import Player
from rejeu.teaching.play.keys import keys_for
from rejeu.teaching.play.window import Window, legend, message, score_summary
from tests.helpers import error_of
from tests.playing import LEVER, Pull, down, hold, lever, perform, pygame, tap, up
from tests.tiers import exhaustive


def box2d(env_id):
    """Skips the test of a Box2D environment where that is not installed; importing it warns, and crashes on errors."""
    if env_id.startswith(("Lunar", "Car")) and "Pole" not in env_id:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pytest.importorskip("Box2D")


EFFECTS = [
    ("CartPole-v1", "d", "velocity", lambda e: e.state[1], +1),
    ("CartPole-v1", "left", "velocity", lambda e: e.state[1], -1),
    ("MountainCar-v0", "d", "velocity", lambda e: e.state[1], +1),
    ("MountainCar-v0", "a", "velocity", lambda e: e.state[1], -1),
    ("MountainCarContinuous-v0", "right", "velocity", lambda e: e.state[1], +1),
    ("MountainCarContinuous-v0", "a", "velocity", lambda e: e.state[1], -1),
    ("Pendulum-v1", "a", "counterclockwise speed", lambda e: e.state[1], +1),
    ("Pendulum-v1", "d", "counterclockwise speed", lambda e: e.state[1], -1),
    ("Acrobot-v1", "d", "speed of the joint", lambda e: e.state[3], +1),
    ("LunarLander-v3", "a", "speed to the right", lambda e: e.lander.linearVelocity.x, -1),
    ("LunarLander-v3", "d", "speed to the right", lambda e: e.lander.linearVelocity.x, +1),
    ("LunarLander-v3", "w", "speed upwards", lambda e: e.lander.linearVelocity.y, +1),
    ("LunarLander-v3", "w+a", "speed upwards", lambda e: e.lander.linearVelocity.y, +1),
    ("LunarLander-v3", "w+a", "speed to the right", lambda e: e.lander.linearVelocity.x, -1),
    ("LunarLanderContinuous-v3", "w+a", "speed upwards", lambda e: e.lander.linearVelocity.y, +1),
    ("LunarLanderContinuous-v3", "w+a", "speed to the right", lambda e: e.lander.linearVelocity.x, -1),
    ("LunarLanderContinuous-v3", "up+right", "speed to the right", lambda e: e.lander.linearVelocity.x, +1),
    ("CarRacing-v3", "w", "speed", lambda e: e.car.hull.linearVelocity.length, +1),
    ("CarRacing-v3", "w+d", "angle against the clock", lambda e: e.car.hull.angle, -1),
    ("CarRacing-v3", "w+a", "angle against the clock", lambda e: e.car.hull.angle, +1),
    ("parking-v0", "w", "speed", lambda e: e.vehicle.speed, +1),
    ("parking-v0", "s", "speed", lambda e: e.vehicle.speed, -1),
    ("parking-v0", "w+d", "heading by the clock", lambda e: e.vehicle.heading, +1),
    ("parking-v0", "w+a", "heading by the clock", lambda e: e.vehicle.heading, -1),
    ("rejeu/Ball-v0", "d", "x", lambda e: e.position[0], +1),
    ("rejeu/Ball-v0", "w+a", "x", lambda e: e.position[0], -1),
    ("rejeu/Ball-v0", "w+a", "y", lambda e: e.position[1], +1),
]


DEAR = [one for one in EFFECTS if one[0].startswith(("Car", "park")) and one[0] != "CartPole-v1" and one[1] != "w"]
"""What ``test_keys`` says of the actions, in environments that are slow to make."""


@pytest.mark.parametrize(
    ("env_id", "keys", "what", "read", "sign"),
    [pytest.param(*one, marks=[exhaustive] * (one in DEAR)) for one in EFFECTS],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_keys_held_move_the_environment_as_they_say(env_id, keys, what, read, sign):
    box2d(env_id)
    steps = 12 if env_id == "CarRacing-v3" else 4
    found = []
    perform(hold(keys.split("+"), steps, read, found), play, env_id, seed=0)
    perform(hold([], steps, read, found), play, env_id, seed=0)  # the same start with nothing held
    assert np.sign(found[0] - found[1]) == sign, what


@exhaustive
def test_the_brake_slows_the_car_down():
    box2d("CarRacing-v3")
    speeds = []

    def script(brake):
        def script(window, game):
            down("w")
            for _ in range(25):
                yield
            up("w")
            down(*brake)
            for _ in range(15):
                yield
            speeds.append(game.players[0].env.unwrapped.car.hull.linearVelocity.length)

        return script

    perform(script(["s"]), play, "Car", seed=0)
    perform(script([]), play, "Car", seed=0)
    assert speeds[0] < 0.8 * speeds[1]


LOST = "lose the keyboard"
STEPS = "rejeu-play-test/Steps-v0"
HELD = {
    "a game begins with the first key that means something": (LEVER, ["tap x", 2, [], "down d", 1, [2]]),
    "keys act from the moment they go down until they go up, and a cancels d": (
        LEVER,
        ["down d", 2, "down a", 1, "up d", 1, "up a", 1, [2, 2, 1, 0, 1]],
    ),
    "a tap shorter than a step counts for one": (LEVER, ["tap d", 3, [2, 1, 1]]),
    "keys are let go when another window takes the keyboard": (LEVER, ["down d", 1, LOST, 1, [2, 1]]),
    "actions that have none for nothing wait for a key": (STEPS, ["tap w", 3, [3], "tap 1", 2, [3, 1]]),
    "p pauses the game and lets it go on": (LEVER, ["down d", 2, "tap p", 3, [2, 2], "tap p", 2, [2] * 4]),
    "space pauses too": (LEVER, ["down d", 2, "tap space", 3, [2, 2], "tap space", 2, [2] * 4]),
}
"""What is pressed, for how many turns, and the actions until then."""


@pytest.mark.parametrize("case", HELD)
def test_keys_are_held_tapped_and_let_go(case):
    env_id, script_of_case = HELD[case]

    def script(window, game):
        for one in script_of_case:
            if isinstance(one, int):
                for _ in range(one):
                    yield
            elif isinstance(one, list):
                assert lever(game).actions == one
            elif one == LOST:
                pygame.event.post(pygame.event.Event(pygame.WINDOWFOCUSLOST))
            else:
                {"down": down, "up": up, "tap": tap}[one.partition(" ")[0]](one.partition(" ")[2])

    perform(script, play, env_id)


def test_own_keys_are_given_on_the_command_line_and_a_space_bar_that_is_bound_does_not_pause():
    def script(window, game):
        tap("j")
        down("space")
        yield
        yield
        assert not game.paused
        assert lever(game).actions == [2, 0]

    assert perform(script, main, ["play", LEVER, "--keys", "j=2", "space=0", "none=1"]) == 0


def test_restart_begins_the_same_start_anew_and_the_episode_does_not_count():
    def script(window, game):
        player = game.players[0]
        down("d")
        yield
        yield
        assert player.score == 4
        up("d")
        tap("r")
        yield
        assert (player.score, player.steps, player.scores, game.phase) == (0, 0, [], "ready")
        assert lever(game).seeds == [7, 7]

    perform(script, play, LEVER, seed=7)


def test_scores_are_summed_the_best_is_kept_and_each_round_has_the_next_seed():
    def script(window, game):
        player = game.players[0]
        for key, score, best in (("d", 10, 10), ("a", 0, 10), ("a", 0, 10)):
            down(key)
            while game.phase != "over":
                yield
            assert (player.score, player.best, player.steps) == (score, best, 5)
            up(key)
            while game.phase == "over":
                yield
        assert lever(game).seeds == [3, 4, 5, 6]
        assert player.mean == pytest.approx(10 / 3)

    perform(script, play, LEVER, seed=3)


def test_the_end_of_a_round_stays_for_a_second_and_a_half():
    def script(window, game):
        down("d")
        while game.phase != "over":
            yield
        up("d")
        turns = 0
        while game.phase == "over":
            yield
            turns += 1
        assert turns == 30  # at 20 steps a second

    perform(script, play, LEVER)


@pytest.mark.parametrize("key", ["q", "escape"])
def test_keys_close_the_window(key):
    def script(window, game):
        tap(key)
        yield
        yield
        raise AssertionError("the window is still open")

    assert perform(script, play, LEVER).closed


def test_episodes_close_the_game_and_the_scores_are_printed(capsys):
    def script(window, game):
        down("d")
        while True:
            yield

    assert perform(script, main, ["play", LEVER, "--episodes", "2", "--seed", "1"]) == 0
    assert capsys.readouterr().out.endswith("you: 2 episodes, mean 10.00, best 10.00\n")


def test_the_rate_is_the_environments_own_or_what_is_asked_for(monkeypatch):
    rates = []

    def script(window, game):
        monkeypatch.setattr(window, "wait", rates.append)
        yield

    perform(script, play, LEVER)
    perform(script, play, LEVER, fps=7)
    assert {*rates} == {20, 7}


def test_the_window_keeps_the_rate():
    with Window("rate") as window:
        window.wait(100)
        began = time.perf_counter()
        for _ in range(20):
            window.wait(100)
        assert 0.19 <= time.perf_counter() - began < 0.4


def test_the_window_shows_both_pictures_side_by_side_and_the_keys_held():
    def script(window, game):
        down("d")
        yield
        yield
        shown = pygame.surfarray.array3d(window.canvas).swapaxes(0, 1)
        grey = (shown == 80).all(2)  # what the lever looks like after two steps
        columns = np.flatnonzero(grey.sum(0) > 250)
        assert len(columns) == 800
        assert len(np.flatnonzero(np.diff(columns) > 1)) == 1
        legend = shown[-30:]
        held = (legend == (40, 104, 190)).all(2).sum()
        up("d")
        yield
        yield
        shown = pygame.surfarray.array3d(window.canvas).swapaxes(0, 1)
        assert held > 100 > (shown[-30:] == (40, 104, 190)).all(2).sum()

    perform(script, play, LEVER, against=Pull())


def test_a_lost_episode_is_called_failed_and_scores_are_summed_up_once_there_is_one(monkeypatch):
    player = Player("you", None, None, steps=5, over=True, success=0.0)
    assert message(Game([player], 0), player) == "failed: 0"
    assert score_summary(player, by_hand=False) == score_summary(player, by_hand=True) == ""
    player.scores.append(-3.0)
    assert score_summary(player, by_hand=False) == "mean -3 of 1 episode   best -3"
    assert score_summary(player, by_hand=True) == "best -3"
    monkeypatch.setenv("REJEU_LANGUAGE", "fr")
    assert score_summary(player, by_hand=False) == "moyenne -3 sur 1 épisode   meilleur -3"
    player.score, player.success = 2.5, 1.0
    assert message(Game([player], 0), player) == "réussi : 2.5"
    entries = legend(keys_for("LunarLander-v3", gym.spaces.Discrete(4), None))
    assert [entry.label for entry in entries][:3] == [
        "left",
        "right",
        "main engine",
    ]  # each page has a language of its own
    assert [said(entry.label) for entry in entries][:3] == ["gauche", "droite", "moteur principal"]


def test_a_rival_plays_the_same_starts_at_the_same_pace():
    def script(window, game):
        you, rival = game.players
        for seed in (11, 12):
            assert game.phase == "ready"
            np.testing.assert_array_equal(you.obs, rival.obs)
            assert rival.env.unwrapped.seeds[-1] == you.env.unwrapped.seeds[-1] == seed
            assert rival.steps == 0
            down("a")
            yield
            assert (you.steps, rival.steps) == (1, 1)
            while game.phase != "over":
                yield
            assert (you.score, rival.score) == (0, 10)
            up("a")
            while game.phase == "over":
                yield
        assert (you.scores, rival.scores) == ([0, 0], [10, 10])

    perform(script, play, LEVER, seed=11, against=Pull())


def test_a_round_is_over_when_both_are():
    def script(window, game):
        you, rival = game.players
        down("d")
        while not you.over:
            yield
        assert not rival.over
        steps = you.steps
        while game.phase != "over":
            yield
        assert rival.over
        assert you.steps == steps

    class Balance:
        """Pushes the cart under its pole."""

        def predict(self, obs, state=None, episode_start=None, deterministic=False):
            return np.int64(obs[2] + obs[3] > 0), None

    perform(
        script, play, lambda **given: gym.make("CartPole-v1", max_episode_steps=60, **given), seed=0, against=Balance()
    )


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A model file of an untrained agent for CartPole."""
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", seed=0, policy_kwargs={"net_arch": [8]})
    return agent.save(tmp_path_factory.mktemp("model") / "cart")


def test_the_agent_of_a_model_file_plays_as_it_predicts(model, capsys):
    agent, env = rejeu.load(model), make_env("CartPole-v1")
    obs, expected, done = env.reset(seed=5)[0], 0.0, False
    while not done:
        obs, reward, terminated, truncated, _ = env.step(agent.predict(obs, deterministic=True)[0])
        expected, done = expected + reward, terminated or truncated
    games = []

    def script(window, game):
        games.append(game)
        down("a")
        while True:
            yield

    argv = ["play", "CartPole-v1", "--against", str(model), "--seed", "5", "--episodes", "1"]
    assert perform(script, main, argv) == 0
    assert games[0].players[1].scores == [expected]
    assert re.search(rf"you: 1 episode, .*\nDQN: 1 episode, mean {expected:.2f}, ", capsys.readouterr().out)


def test_an_agent_of_another_environment_is_refused(model, capsys):
    assert "plays CartPole-v1, not MountainCar-v0" in error_of(capsys, "play", "Mountain", "--against", str(model))


def test_watch_shows_an_agent_without_waiting_and_prints_its_mean(model, capsys):
    scores = []

    def script(window, game):
        assert game.phase == "running"
        assert not game.bound
        scores.append(game.players[0].scores)
        while True:
            yield

    assert perform(script, main, ["watch", str(model), "--episodes", "3", "--seed", "5"]) == 0
    mean, best = np.mean(scores[0]), max(scores[0])
    assert capsys.readouterr().out.endswith(f"DQN: 3 episodes, mean {mean:.2f}, best {best:.2f}\n")


def test_watch_can_be_paused_begun_anew_and_closed():
    def script(window, game):
        yield
        yield
        tap("p")
        yield
        yield
        assert game.players[0].steps == 2
        tap("r")
        yield
        assert (game.players[0].steps, game.players[0].env.unwrapped.seeds) == (1, [4, 4])
        tap("q")
        yield
        yield
        raise AssertionError("the window is still open")

    perform(script, watch, Pull(), LEVER, seed=4)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["play", "Lunr"], "did you mean Lunar?"),
        (["play", "MountanCar-v0"], "did you mean MountainCar-v0"),
        (["play", "rejeu-play-test/Dark-v0"], "cannot be rendered to arrays: its render modes are ['ansi']"),
        (["play", "rejeu-play-test/Switches-v0"], "MultiBinary(3) cannot be played by hand"),
        (["play", LEVER, "--keys", "a"], "--keys 'a' must be keys=action"),
        (["play", LEVER, "--keys", "a=5"], "a=5 must be an integer from 0 to 2"),
        (["play", LEVER, "--keys", "q=1"], "'q' cannot be bound"),
        (["play", LEVER, "--fps", "0"], "fps=0"),
        (["play", LEVER, "--episodes", "0"], "episodes=0"),
        (["play", LEVER, "--seed", "-1"], "seed=-1"),
        (["play", LEVER, "--against", "no-such-run"], "no run folder or model file no-such-run"),
        (["watch", "no-such-run"], "no run folder or model file no-such-run"),
    ],
)
def test_what_is_wrong_is_one_line_that_names_the_fix(capsys, argv, message):
    assert message in error_of(capsys, *argv)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a screen")
@pytest.mark.parametrize("driver", ["x11", None])
def test_without_a_screen_there_is_an_error_and_no_hidden_window(capsys, monkeypatch, driver):
    pygame.quit()
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    if driver is not None:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "cannot open a window" in error_of(capsys, "play", LEVER)


def test_environments_are_closed_and_the_window_is_gone_after_a_game():
    game = perform(lambda window, game: iter(()), play, "CartPole-v1")
    assert isinstance(game, Game)
    assert not pygame.display.get_init() or pygame.display.get_surface() is None
    with Window("again") as window:
        assert window.title == "again"

"""Pages of HTML in which a policy acts: the policy and the environment are compared in Node.js, and the page runs."""

import re
import shutil

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.agents import exporting
from rejeu.export import check, web_file
from rejeu.export.web_file import node
from rejeu.lab.cli import main
from tests.export.policies import made
from tests.tiers import only

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="there is no Node.js")
CASES = {
    "CartPole-v1": "PPO",
    "Pendulum-v1": "SAC",
    "MountainCar-v0": "DQN",
    "MountainCarContinuous-v0": "TD3",
    "rejeu/Ball-v0": "DDPG",
    "jax/Parking-v0": "SAC",
}
PARTS = only(["CartPole-v1", "Pendulum-v1"], CASES)
DRIVER = """
const found = [];
for (const [state, action, draws] of JSON.parse(require("fs").readFileSync(0, "utf8"))) {
  found.push(stepWorld(...state, action, ...draws).map((one) => Array.from(one)));
}
console.log(JSON.stringify(found));
"""
DOCUMENT = """
let turns, drawn = 0;
const elements = {}, listeners = {};
const pen = new Proxy({}, { get: () => () => { drawn += 1; }, set: () => true });
const element = (id) => elements[id] ??= { getContext: () => pen };
const document = { getElementById: element };
const addEventListener = (name, listener) => { listeners[name] = listener; };
const setInterval = (callback) => { turns = callback; };
"""
PLAYING = """
for (let i = 0; i < 20; ++i) turns();
const before = [drawn, elements["policy-score"].textContent, elements["person-score"].textContent];
listeners.keydown({ key: "ArrowRight", preventDefault() {} });
for (let i = 0; i < 5; ++i) turns();
console.log(JSON.stringify([...before, drawn, elements["person-score"].textContent, elements.title.textContent]));
"""


def agent_for(env_id):
    small = {"policy_kwargs": {"net_arch": [16]}}
    policy = "MultiInputPolicy" if "Parking" in env_id else "MlpPolicy"
    return made(CASES[env_id], policy, env_id, **small)


def script_of(env_id):
    agent = agent_for(env_id)
    one = exporting.policy_for(agent, False, 1)
    env = web_file.environment(env_id, {})
    return web_file.script(one, env, exporting.card_of(agent, one, "web", "", None)), env


@pytest.mark.parametrize("env_id", PARTS)
def test_the_policy_of_a_page_acts_as_predict(env_id, tmp_path, monkeypatch):
    monkeypatch.setattr(check, "OBSERVATIONS", 100)
    found = agent_for(env_id).export(tmp_path / "page.html")
    assert (found.target, found.check.n, found.check.source) == ("web", 100, env_id)
    assert found.check.difference <= 1e-5
    text = found.path.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert not re.search(r"https?:|src=|import\(", text)


def test_no_text_of_a_card_ends_the_script_of_a_page():
    agent = agent_for("CartPole-v1")
    one = exporting.policy_for(agent, False, 1)
    card = exporting.card_of(agent, one, "web", "</script><!--", None)
    script = web_file.script(one, web_file.environment("CartPole-v1", {}), card)
    assert "<" not in next(line for line in script.splitlines() if line.startswith("const ABOUT"))
    assert node(script + "\nconsole.log(JSON.stringify(ABOUT.card.source));", None) == "</script><!--"


def test_a_policy_with_memory_acts_as_predict(tmp_path, monkeypatch):
    monkeypatch.setattr(check, "OBSERVATIONS", 100)
    agent = made("RecurrentPPO", "MlpPolicy", "Pendulum-v1", policy_kwargs={"lstm_hidden_size": 8, "net_arch": [8]})
    assert agent.export(tmp_path / "page.html").check.difference <= 1e-5


@pytest.mark.parametrize("env_id", PARTS)
def test_the_environment_of_a_page_steps_as_in_jax(env_id):
    script, env = script_of(env_id)
    rng, step, given, expected = np.random.default_rng(0), jax.jit(env.step), [], []
    env.action_space.seed(0)
    key = jax.random.PRNGKey(0)
    state, _ = env.reset(key)
    for _ in range(60):
        key = jax.random.fold_in(key, 1)
        action = env.action_space.sample()
        draws = [np.asarray(jax.random.normal(key, (2,))).tolist()] if "Ball" in env_id else []
        leaves = [np.ravel(one).astype(float).tolist() for one in jax.tree.leaves(state)]
        given.append((leaves, np.ravel(action).tolist(), draws))
        found = step(key, state, action)
        expected.append([np.ravel(one).astype(float) for one in jax.tree.leaves(found)])
        state = env.reset(key)[0] if rng.random() < 0.02 or found[3] else found[0]
    for one, other in zip(node(script + DRIVER, given), expected, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5, rtol=1e-5)


def test_episodes_start_as_in_jax():
    driver = "console.log(JSON.stringify([0, 0.25, 0.999].map((u) => resetWorld({}).map((x) => x[0]))));"
    script, _ = script_of("Pendulum-v1")
    angles = [state[0] for state in node(script + driver.format("[u, u]"), None)]
    np.testing.assert_allclose(angles, [-np.pi, -np.pi / 2, np.pi * 0.998], rtol=1e-5)
    script, _ = script_of("jax/Parking-v0")
    driver = """
    const goals = Array.from({ length: 27 }, (_, i) => resetWorld([0.25], [(i + 0.5) / 27])[6][0]);
    console.log(JSON.stringify([goals, resetWorld([0.25], [0])[1][0]]));
    """
    goals, heading = node(script + driver, None)
    assert goals == [i for i in range(28) if i != 6]  # the spot in the row ahead that highway-env excludes
    np.testing.assert_allclose(heading, np.pi / 2, rtol=1e-5)


DRAWS = "let drawnBefore = 1; Math.random = () => (drawnBefore = (drawnBefore * 16807) % 2147483647) / 2147483647;\n"
"""The same random numbers in every run, so that no episode happens to end where the page is looked at."""


@pytest.mark.parametrize("env_id", only(["CartPole-v1", "jax/Parking-v0"], CASES))
def test_the_page_plays(env_id):
    script, _ = script_of(env_id)
    (body,) = re.findall(r"<script>\n(.*)</script>", web_file.write(script).decode(), re.DOTALL)
    drawn, policy, person, later, played, title = node(DRAWS + DOCUMENT + body + PLAYING, None)
    assert drawn > 100
    assert re.fullmatch(r"Return -?\d+\.\d after \d+ steps(, over)?", policy)
    assert not policy.endswith("after 0 steps")
    assert person == "Press an arrow key to play."
    assert later > drawn
    assert played.startswith("Return ")
    assert "after 5 steps" in played or "over" in played
    assert title == f"{CASES[env_id]} in {env_id}"


def test_what_a_page_cannot_contain_is_one_line(tmp_path):
    agent = agent_for("CartPole-v1")
    for arguments, message in (
        ({"noise": True}, "web contains the deterministic policy"),
        ({"batch": 2}, "web takes one observation at a time"),
    ):
        with pytest.raises(ValueError, match=message):
            agent.export(tmp_path / "page.html", **arguments)
    assert not [*tmp_path.iterdir()]
    for env_id, kwargs, message in (
        ("Acrobot-v1", {}, "cannot contain Acrobot-v1; it can contain CartPole-v1"),
        (None, {}, "given as an object .name it: agent.set_env"),
        ("rejeu/Ball-v0", {"dimension": 3}, "in two dimensions"),
        ("CartPole-v1", {"speed": 3}, "CartPole-v1 with the arguments speed"),
    ):
        with pytest.raises(ValueError, match=message):
            web_file.environment(env_id, kwargs)


def test_export_names_the_environment_of_a_page(tmp_path, capsys):
    model = rejeu.PPO("MlpPolicy", gym.make("CartPole-v1"), seed=0).save(tmp_path / "model")
    assert main(["export", str(model), "--to", "web"]) == 2
    assert "--env ID" in capsys.readouterr().err
    assert main(["export", str(model), "--to", "web", "--env", "CartPole-v1"]) == 0

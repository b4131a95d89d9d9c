"""The leaderboard of a folder of models: ranks, limits, and files that are not what they should be."""

import json
import zipfile

import numpy as np
import pytest

import rejeu
from rejeu.lab.cli import courses, main
from rejeu.logs.evaluation import Evaluation, evaluate
from rejeu.teaching.courses import leaderboard

pytestmark = pytest.mark.usefixtures("learners_are_shared")
HOSTILE = "<script>alert(1)<_script> | *x*"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with two equal models, one of another environment, and damaged files."""
    folder = tmp_path_factory.mktemp("class")
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    agent.save(folder / "anna")
    (folder / "second").mkdir()
    agent.save(folder / "second" / HOSTILE)
    rejeu.DQN("MlpPolicy", "MountainCar-v0", policy_kwargs={"net_arch": [8]}, seed=0).save(folder / "other")
    data = (folder / "anna.safetensors").read_bytes()
    (folder / "cut.safetensors").write_bytes(data[: len(data) // 2])
    (folder / "empty.safetensors").write_bytes(b"")
    (folder / "flipped.safetensors").write_bytes(data[:-20] + bytes([data[-20] ^ 255]) + data[-19:])
    (folder / "second" / "checkpoints").mkdir()
    (folder / "second" / "checkpoints" / "run_000000000000.safetensors").write_bytes(b"")
    (folder / "notes.txt").write_text("not a model", encoding="utf-8")
    return folder


def run(folder, out, *options):
    """Returns the leaderboard that a command writes: the content of a JSON file, else the text."""
    assert main(["class", str(folder), "--episodes", "3", "--out", str(out), *options]) == 0
    text = out.read_text(encoding="utf-8")
    return json.loads(text) if out.suffix == ".json" else text


def test_models_are_ranked_and_other_files_get_one_line_each(folder, tmp_path, capsys):
    board = run(folder, tmp_path / "board.json")
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert [line.partition(":")[0] for line in lines[1:7]] == [
        "anna",
        "cut",
        "empty",
        "flipped",
        "other",
        f"second/{HOSTILE}",
    ]
    (row,) = [line for line in lines[7:] if line.strip().startswith("1 to 2") and "anna" in line]
    assert row.split()[3:6] == ["anna", "DQN", "0"]
    assert lines.count("other: it was trained on MountainCar-v0, not on CartPole-v1") == 1
    assert lines[-2] == f"the page of the class: rejeu studio {folder}"
    assert board["env_id"] == "CartPole-v1"
    first, second = board["models"]
    assert [first["name"], second["name"]] == ["anna", f"second/{HOSTILE}"]
    assert first["places"] == second["places"] == [1, 2]
    reasons = {one["name"]: one["reason"] for one in board["not_evaluated"]}
    assert reasons.keys() == {"cut", "empty", "flipped", "other"}
    assert reasons["other"] == "it was trained on MountainCar-v0, not on CartPole-v1"
    assert "checksum" in reasons["flipped"]
    assert first["returns"] == second["returns"]  # of the same episodes
    assert len(set(first["returns"])) > 1
    board = run(folder, tmp_path / "board.json", "--minutes", "0.00001", "--json")
    assert not board["models"]
    assert "it needs more than" in board["not_evaluated"][0]["reason"]
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {**board, "file": str(tmp_path / "board.json")}
    assert "cut: " in printed.err
    board = run(folder, tmp_path / "board.json", "--env", "MountainCar-v0")
    assert [model["name"] for model in board["models"]] == ["other"]


def test_many_episodes_are_played_in_few_environments_and_are_the_same(folder, tmp_path, monkeypatch):
    numbers_of_envs = []

    def counted(choose, env, *arguments):
        numbers_of_envs.append(env.n_envs)
        return evaluate(choose, env, *arguments)

    monkeypatch.setattr(leaderboard, "evaluate", counted)
    options = ("--seed", "7", "--episodes", "5")
    at_once = run(folder, tmp_path / "at_once.json", *options)["models"][0]
    monkeypatch.setattr(courses, "MOST_ENVS", 2)
    in_turns = run(folder, tmp_path / "in_turns.json", *options)["models"][0]
    assert numbers_of_envs == [5, 5, 2, 2, 2, 2, 2, 2]  # two models
    assert sorted(in_turns["returns"]) == sorted(at_once["returns"])
    assert in_turns["mean_length"] == at_once["mean_length"]


def test_the_places_of_a_model_are_those_that_the_intervals_allow():
    def model(name, *returns):
        returns = np.array(returns)
        return leaderboard.Entrant(name, "DQN", 0, 0, Evaluation(returns, returns, returns))

    wide, high, low = model("wide", 0.0, 10.0, 20.0), model("high", 14.0, 15.0, 16.0), model("low", 1.0, 2.0, 3.0)
    assert wide.interval[0] < low.interval[0] < low.interval[1] < high.interval[0] < high.interval[1] < wide.interval[1]
    places = [(one.name, one.first, one.last) for one in leaderboard.ranked([low, wide, high, model("one", 30.0)])]
    assert places == [("one", 1, 2), ("high", 2, 3), ("wide", 1, 4), ("low", 3, 4)]


@pytest.fixture
def entrants(tmp_path):
    """A file of ``rejeu.sb3``, a copy of it under another suffix and another name, a run folder, and a zip file of others."""
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    for name in (
        "anna.zip",
        "anna.safetensors",
        "ben/best.safetensors",
        "ben/agent.safetensors",
        "ben/live.safetensors",
        "ben/models/step_000000000100.safetensors",
        "odd/agent.safetensors",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        agent.save(tmp_path / name)
    (tmp_path / "ben" / "config.json").write_text("{}", encoding="utf-8")
    with zipfile.ZipFile(tmp_path / "theirs.zip", "w") as file:
        file.writestr("data", "{}")
    return tmp_path


def test_zip_files_are_models_and_a_run_folder_is_one_entrant(entrants):
    board = run(entrants, entrants / "board.json")
    names = ["anna.safetensors", "anna.zip", "ben", "odd/agent"]
    assert [model["name"] for model in board["models"]] == names
    assert board["equal_files"] == [names]
    (other,) = board["not_evaluated"]
    assert other["name"] == "theirs"
    assert "rejeu import" in other["reason"]
    assert f"- Le même fichier : {', '.join(names)}" in run(entrants, entrants / "board.md", "--language", "fr")
    (model,) = run(entrants / "ben", entrants / "board.json")["models"]
    assert model["name"] == "ben"


def test_a_leaderboard_in_french_which_the_setting_asks_for(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("REJEU_LANGUAGE", "fr")
    text = run(folder, tmp_path / "board.md")
    out = capsys.readouterr().out
    assert out.startswith("CartPole-v1, 3 épisodes pour chacun des 6 modèles\nanna : retour moyen ")
    assert "\ncut : le fichier est endommagé" in out
    assert "| place | modèle | algorithme | pas | graine | retour moyen |" in text
    assert "| 1 à 2 | anna | DQN | 0 | 0 |" in text
    assert "il a été entraîné sur MountainCar-v0, et non sur CartPole-v1" in text
    broken = "le fichier est endommagé, ou ce n'est pas un modèle que rejeu peut évaluer"
    assert [line.split(": ")[1] for line in text.splitlines() if line.startswith(("- cut", "- empty", "- flip"))] == (
        [broken] * 3
    )
    monkeypatch.setenv("REJEU_LANGUAGE", "de")
    assert main(["class", str(folder)]) == 2
    assert "language='de' must be one of en, fr" in capsys.readouterr().err


def test_names_are_escaped_in_markdown(folder, tmp_path):
    row = next(line for line in run(folder, tmp_path / "board.md").splitlines() if "second" in line)
    assert r"second/\<script\>alert(1)\<\_script\> \| \*x\*" in row


def test_a_model_whose_returns_are_not_finite_is_not_ranked(tmp_path):
    agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    agent.save(tmp_path / "good")
    agent.run.state = [leaf * 0 + 3e38 if leaf.dtype == "float32" else leaf for leaf in agent.run.state]
    agent.save(tmp_path / "huge")
    board = run(tmp_path, tmp_path / "board.json")
    assert [model["name"] for model in board["models"]] == ["good"]
    assert [one["name"] for one in board["not_evaluated"]] == ["huge"]


def test_success_is_not_what_the_author_of_a_file_calls_so(tmp_path):
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=0, success_threshold=-1e9)
    agent.save(tmp_path / "proud")
    for options, rate in (((), 0.0), (("--success-threshold", "1"), 1.0)):
        (model,) = run(tmp_path, tmp_path / "board.json", *options)["models"]
        assert (model["success_rate"], model["seed"], model["steps"]) == (rate, 0, 0)


def test_large_files_and_symbolic_links_are_not_opened(tmp_path, monkeypatch, capsys):
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    small = agent.save(tmp_path / "small")
    rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [64, 64]}, seed=0).save(tmp_path / "large")
    try:
        (tmp_path / "link.safetensors").symlink_to(small)
    except OSError:
        pytest.skip("no symbolic links here")
    monkeypatch.setattr(leaderboard, "MAX_BYTES", small.stat().st_size)
    board = run(tmp_path, tmp_path / "board.json")
    assert [model["name"] for model in board["models"]] == ["small"]
    assert [one["name"] for one in board["not_evaluated"]] == ["large"]
    assert "MiB at most" in board["not_evaluated"][0]["reason"]
    french = run(tmp_path, tmp_path / "board.md", "--language", "fr")
    assert "- large : le fichier a 0 Mio, au lieu de 0 Mio au plus" in french


def test_a_model_whose_spaces_are_not_those_of_its_environment_is_not_ranked(tmp_path):
    agent = rejeu.DQN("MlpPolicy", "Acrobot-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    agent.run.env.env_id = "CartPole-v1"
    agent.save(tmp_path / "other")
    for language, reason in (("en", "(6,)"), ("fr", "ses observations ou ses actions ne sont pas celles de CartPole")):
        (problem,) = run(tmp_path, tmp_path / "board.json", "--language", language)["not_evaluated"]
        assert reason in problem["reason"]

"""Models on the hub, against stand-ins of the package for it and of its server, without network."""

from __future__ import annotations

import inspect
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

import rejeu
from rejeu import hub
from rejeu.cli import main
from rejeu.errors import CheckpointError
from tests import hub_server

SB3 = Path(__file__).parent / "data" / "sb3"


class TransportError(Exception):
    pass


class HfHubHTTPError(TransportError, OSError):
    pass


class HFValidationError(ValueError):
    pass


class LocalTokenNotFoundError(OSError):
    pass


@pytest.fixture
def server(tmp_path, monkeypatch):
    """Puts a stand-in in the place of huggingface_hub, whose repositories are the folders of the folder returned."""
    root = tmp_path / "server"
    root.mkdir()

    class HfApi:
        def create_repo(self, repo_id, *, private=None, exist_ok=False):
            if " " in repo_id:
                raise HFValidationError(f"Repo id is wrong:\n{repo_id}")
            if repo_id.startswith("others/"):
                raise HfHubHTTPError("403 Forbidden")
            (root / repo_id).mkdir(parents=True, exist_ok=exist_ok)
            return f"https://hub/{repo_id}"

        def upload_folder(self, *, repo_id, folder_path, commit_message):
            shutil.copytree(folder_path, root / repo_id, dirs_exist_ok=True)

        def list_repo_files(self, repo_id):
            if repo_id.startswith("away/"):
                raise TransportError("Connection refused")
            if not (root / repo_id).is_dir():
                raise HfHubHTTPError("404 Not Found")
            files = (path for path in (root / repo_id).rglob("*") if path.is_file())
            return ["../../evil.zip", *(path.relative_to(root / repo_id).as_posix() for path in files)]

    def hf_hub_download(repo_id, filename, *, local_dir):
        target = Path(local_dir) / filename
        target.parent.mkdir(parents=True, exist_ok=True)
        (Path(local_dir) / ".cache").mkdir(exist_ok=True)
        shutil.copyfile(root / repo_id / filename, target)

    module, errors = ModuleType("huggingface_hub"), ModuleType("huggingface_hub.errors")
    module.HfApi, module.hf_hub_download, module.errors = HfApi, hf_hub_download, errors
    for error in (HfHubHTTPError, HFValidationError, LocalTokenNotFoundError):
        setattr(errors, error.__name__, error)
    monkeypatch.setitem(sys.modules, "huggingface_hub", module)
    monkeypatch.setitem(sys.modules, "huggingface_hub.errors", errors)
    monkeypatch.chdir(tmp_path)
    return root


@pytest.fixture
def run(tmp_path):
    """Returns a small run folder."""
    folder = tmp_path / "run"
    folder.mkdir()
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    agent.save(folder / "agent")
    agent.save(folder / "best")
    (folder / "config.json").write_text(json.dumps({"env_id": "CartPole-v1", "algorithm": "DQN", "seed": 0}))
    (folder / "evaluations.csv").write_text(
        "step,episodes,mean_return,std_return,mean_length,success_rate\n100,10,20,3,20,\n200,10,30,3,30,\n"
    )
    (folder / "curve.png").write_bytes(b"a picture")
    (folder / "secrets.txt").write_text("private")
    return folder


def test_a_model_is_pushed_with_its_card_and_pulled_again(server, run, capsys):
    assert main(["push", str(run), "me/cart"]) == 0
    assert "https://hub/me/cart" in capsys.readouterr().out
    found = {path.name for path in (server / "me" / "cart").iterdir()}
    assert {"agent.safetensors", "config.json", "evaluations.csv", "curve.png", "README.md"} <= found
    assert "secrets.txt" not in found
    card = (server / "me" / "cart" / "README.md").read_text(encoding="utf-8")
    # The interval of 10 episodes: 30 -+ 2.262 * 3 / sqrt(9), with the 97.5 % quantile of Student's t at 9 degrees of freedom
    assert "return 30.00 ± 3.00 (95 % confidence interval of the mean 27.74 to 32.26), 10 episodes" in card
    assert "![Learning curve](curve.png)" in card
    metadata = dict(line.split(": ", 1) for line in card.split("---")[1].strip().splitlines())
    assert json.loads(metadata["library_name"]) == "rejeu"
    assert json.loads(metadata["model-index"])[0]["results"][0]["metrics"][0]["value"] == 30

    assert main(["pull", "me/cart"]) == 0
    assert "rejeu evaluate cart" in capsys.readouterr().out
    pulled = rejeu.load("cart/agent.safetensors").get_parameters()
    assert all((pulled[key] == value).all() for key, value in rejeu.load(run / "best").get_parameters().items())
    assert not Path("cart/.cache").exists()


def test_only_known_files_of_the_top_folder_are_pulled(server, capsys):
    repo = server / "me" / "theirs"
    (repo / "inner").mkdir(parents=True)
    for name in ("model.zip", "vecnormalize.pkl"):
        shutil.copy(SB3 / f"ppo-normalized{Path(name).suffix}", repo / name)
    for name in ("train.py", "inner/other.zip"):
        (repo / name).write_text("print()")
    assert main(["pull", "me/theirs", "--out", "here"]) == 0
    assert sorted(path.name for path in Path("here").rglob("*")) == ["model.zip", "vecnormalize.pkl"]
    assert "rejeu import" in capsys.readouterr().out


def test_nothing_is_left_of_a_damaged_model(server, tmp_path):
    (server / "me" / "bad").mkdir(parents=True)
    (server / "me" / "bad" / "agent.safetensors").write_bytes(b"nothing")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(CheckpointError, match="not a complete safetensors file"):
        hub.pull("me/bad")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(("repo", "error", "message"), [
    ("others/x", OSError, "the hub answered: 403 Forbidden; hf auth login"),
    ("me/a b", ValueError, "not the name of a repository, such as USER/MODEL: Repo id is wrong: me/a b"),
])  # fmt: skip
def test_refusals_of_a_push_are_one_line(repo, error, message, server, run):
    with pytest.raises(error, match=message):
        hub.push(run, repo, note=lambda text: None)


@pytest.mark.parametrize(("repo", "message"), [
    ("me/none", "the hub answered: 404"), ("away/x", "the hub cannot be reached: Connection refused"),
])  # fmt: skip
def test_refusals_of_a_pull_are_one_line(repo, message, server):
    with pytest.raises(OSError, match=message):
        hub.pull(repo)


def test_a_folder_with_content_is_not_replaced(server):
    Path("full").mkdir()
    Path("full/file").touch()
    with pytest.raises(FileExistsError, match="--out"):
        hub.pull("me/full")


@pytest.fixture
def served_hub(tmp_path, monkeypatch):
    """The real huggingface_hub, whose server is a stand-in on this machine; returns its repositories."""
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setenv("HF_TOKEN", hub_server.TOKEN)
    monkeypatch.chdir(tmp_path)
    with hub_server.served() as (address, repos):
        monkeypatch.setattr(constants, "ENDPOINT", address)
        template = constants.HUGGINGFACE_CO_URL_TEMPLATE
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + template[template.index("/{") :])
        yield repos


def test_the_package_of_the_hub_pushes_and_pulls_over_http(served_hub, run, capsys):
    assert main(["push", str(run), "me/cart"]) == 0
    assert "/me/cart" in capsys.readouterr().out
    found = served_hub["me/cart"]
    assert {"agent.safetensors", "config.json", "curve.png", "README.md"} <= {*found}
    assert found["agent.safetensors"] == (run / "best.safetensors").read_bytes()
    found |= {"train.py": b"print()", "inner/other.zip": b"PK"}
    assert main(["pull", "me/cart", "--out", "back"]) == 0
    pulled = {path.relative_to("back").as_posix() for path in Path("back").rglob("*")}
    assert pulled == {*found} - {".gitattributes", "train.py", "inner/other.zip"}
    assert Path("back/agent.safetensors").read_bytes() == found["agent.safetensors"]


def test_refusals_over_http_are_one_line_and_leave_nothing(served_hub, run, tmp_path, monkeypatch):
    with pytest.raises(OSError, match="the hub answered: ") as error:
        hub.pull("me/none", tmp_path / "none")
    assert "\n" not in str(error.value)
    with pytest.raises(OSError, match=r"the hub answered: .*403"):
        hub.push(run, "others/x", note=lambda text: None)
    served_hub["me/bad"] = {"agent.safetensors": b"nothing"}
    with pytest.raises(CheckpointError, match="not a complete safetensors file"):
        hub.pull("me/bad", tmp_path / "bad")
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    with pytest.raises(OSError, match=r"the hub answered: .*401"):
        hub.push(run, "me/cart", note=lambda text: None)
    assert not (tmp_path / "none").exists()
    assert not (tmp_path / "bad").exists()


def test_the_calls_are_those_of_the_real_interface():
    real = pytest.importorskip("huggingface_hub")
    from huggingface_hub import errors

    inspect.signature(real.HfApi.create_repo).bind(None, "a/b", private=None, exist_ok=True)
    inspect.signature(real.HfApi.upload_folder).bind(None, repo_id="a/b", folder_path="a", commit_message="b")
    inspect.signature(real.HfApi.list_repo_files).bind(None, "a/b")
    inspect.signature(real.hf_hub_download).bind("a/b", "file", local_dir="a")
    assert issubclass(errors.HfHubHTTPError, errors.HfHubHTTPError.__bases__[0])
    assert issubclass(errors.HFValidationError, ValueError)
    assert issubclass(errors.LocalTokenNotFoundError, OSError)

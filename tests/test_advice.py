"""What messages tell people to type exists: commands, options, arguments, names and extras."""

import ast
import importlib
import re
import tomllib
from pathlib import Path

import gymnasium as gym

import rejeu
from rejeu.lab.cli.commands import COMMANDS
from rejeu.lab.runs.config import options

ROOT = Path(__file__).parents[1]
PROSE = {
    "chose",
    "does",
    "ended",
    "has",
    "holds",
    "is",
    "printed",
    "reads",
    "takes",
    "then",
    "trains",
    "tries",
    "wrote",
}
"""Verbs that follow the name of the package where no command is meant."""
ELSEWHERE = {"autoreset_mode", "episode_reward", "features_extractor_class", "optimizer_class"} | {
    "padding_type",
    "vectorization_mode",
}
"""Arguments of Gymnasium, keys of the original's ``policy_kwargs``, and what its callbacks print."""
OF_OTHERS = {"--head", "--help", "--version"}
"""Options of all commands, and of Ray."""

TREES = {path: ast.parse(path.read_text("utf-8")) for path in sorted((ROOT / "src" / "rejeu").rglob("*.py"))}


def messages():
    """Yields file and line of each text of several words that is no docstring, with ``{}`` for what is inserted."""
    for path, tree in TREES.items():
        hidden = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                hidden |= {id(part) for part in node.values}
                text = "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in hidden:
                text = node.value
            else:
                continue
            if " " in text.strip() and not re.search(r"<[a-z/]+|var\(--|[{;] ?--", text):  # no HTML or CSS
                yield f"{path.relative_to(ROOT)}:{node.lineno}", text


MESSAGES = [*messages()]


def option_names(command):
    return {option.name for option in options(COMMANDS[command])}


def test_commands_and_their_options_exist():
    wrong, n_commands = [], 0
    every = OF_OTHERS.union(*map(option_names, COMMANDS))
    for place, text in MESSAGES:
        for match in re.finditer(r"\brejeu ([a-z]+)\b([^;,.()]*)", text):
            command, rest = match.groups()
            n_commands += command in COMMANDS
            named = set(re.findall(r"--[a-z][a-z-]*", rest))
            if command not in COMMANDS and command not in PROSE:
                wrong.append(f"{place} rejeu {command}")
            elif command in COMMANDS and named - option_names(command):
                wrong.append(f"{place} {match[0]}")
        wrong += [
            f"{place} {one}" for one in re.findall(r"(?<![\w(-])--[a-z][a-z-]+(?![\w:{-])", text) if one not in every
        ]
    assert wrong == []
    assert n_commands > 40


def test_names_of_the_package_exist():
    wrong = []
    for place, text in MESSAGES:
        for path in re.findall(r"(?<![\w`])rejeu((?:\.[A-Za-z_]\w*)+)", text):
            holder = rejeu
            for name in path.split(".")[1:]:
                if not hasattr(holder, name):
                    try:
                        importlib.import_module(f"{holder.__name__}.{name}")
                    except (ImportError, AttributeError):
                        wrong.append(f"{place} rejeu{path}")
                        break
                holder = getattr(holder, name)
        wrong += [
            f"{place} gymnasium.{name}" for name in re.findall(r"\bgymnasium\.(\w+)\(", text) if not hasattr(gym, name)
        ]
    assert wrong == []


def test_extras_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    named = {
        extra for _, text in MESSAGES for one in re.findall(r"rejeu\[([a-z,]+)\]", text) for extra in one.split(",")
    }
    for tree in TREES.values():
        for call in ast.walk(tree):
            if isinstance(call, ast.Call) and getattr(call.func, "attr", getattr(call.func, "id", "")) in (
                "requires",
                "MissingExtra",
            ):
                values = [*call.args[2:], *(one.value for one in call.keywords if one.arg == "extra")]
                named |= {value.value for value in values if isinstance(value, ast.Constant)}
    assert named - {*extras, ""} == set()
    assert len(named) > 8


def parameters():
    """Returns the names of parameters, fields and properties of the package, and of arguments that it passes on."""
    names = set()
    for tree in TREES.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.arg | ast.keyword):
                names.add(node.arg)
            elif isinstance(node, ast.FunctionDef):
                names.add(node.name)
            elif isinstance(node, ast.AnnAssign | ast.Assign):
                for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                    names.add(getattr(target, "id", getattr(target, "attr", "")))
    return names


def test_arguments_that_messages_name_exist():
    known = parameters() | ELSEWHERE
    wrong = [
        f"{place} {name}="
        for place, text in MESSAGES
        for name in re.findall(r"(?<![\w.'\"<&?-])([a-z][a-z_]+)=(?![=\s])", text)
        if name not in known and "lab/studio" not in place  # which sets properties of its elements so
    ]
    assert wrong == []

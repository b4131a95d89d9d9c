"""Runs the Python blocks of Stable-Baselines3's documentation with either library, and tabulates which run.

    python trials/sb3_guide.py CHECKOUT [CONTRIB] --original PYTHON --packages SITE_PACKAGES

The checkouts are those of stable-baselines3 and sb3-contrib; nothing of them is a part of this repository. ``PYTHON`` is an
interpreter that has both and PyTorch; ``SITE_PACKAGES`` has what blocks need besides, such as ale-py. Each block of
``docs/guide``, ``docs/modules`` and ``docs/common`` runs in a process and an empty folder: with the original, and with imports
replaced by this interpreter. Both get the same changes: ``learn`` takes at most 300 steps, callbacks act every 60, evaluations
play two episodes, loops have 20 or 50 rounds, ids of environments that no longer exist become those of today, and there are no
windows. A block that does not know a name runs after the blocks before it on its page that ran.

A row of the table has what either library raised or left, the names with the kinds of their values and the files, and in
``differs`` what is not the same; ``torch`` says whether the block uses PyTorch. A block that the original cannot run, as
it is pseudocode or lacks a package, an environment or time, is not run with rejeu. ``--only`` runs some blocks and keeps the
results of the others, ``--join`` takes those of other runs over. Results of the original are kept unless ``--again`` is given.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from trials.provenance import ROOT, provenance, write

RESULT = Path(__file__).parent / "results" / "sb3_guide.json"
FENCE = re.compile(r"^ *(`{3,})(?:\{code-block\} *)?python *\n(.*?)^ *\1 *$", re.DOTALL | re.MULTILINE)
TORCH = r"\btorch\b|\bth\.|\bnn\."
CANNOT = r"takes more|SyntaxError|NameError|ModuleNotFoundError|ImportError|gymnasium\.error"
"""Errors of the original that are no result: of pseudocode, of packages and environments that are not there, and of time."""
ERROR = r"^[A-Za-z_.]+(Error|Exception|Found|Env|Extra|Interrupt)\b"
"""The line of a traceback that names the error."""
IMPORTS = ((r"\bstable_baselines3\b", "rejeu.sb3"), (r"\bsb3_contrib\b", "rejeu.sb3_contrib"))
CHANGES = (
    (r"while True:", "for _ in range(20):"),
    (r"Pendulum-v0", "Pendulum-v1"),
    (r"HalfCheetah(BulletEnv-v0|-v4)", "HalfCheetah-v5"),
    (r"(?m)^.*\bpybullet_envs_gymnasium.*\n", ""),
    (r"(_freq=|NTimesteps\(n_steps=)\d{3,}", r"\g<1>60"),
    (r"n_eval_episodes=\d+", "n_eval_episodes=2"),
    (r"range\(\d?_?\d{3,}\)", "range(50)"),
)
BEFORE = """
def _cap(path, *names, most=300):
    import functools, importlib
    module = importlib.import_module(path)
    for name in names:
        kind = getattr(module, name)
        def learn(self, total_timesteps, *args, _learn=kind.learn, **kwargs):
            return _learn(self, min(total_timesteps, most), *args, **kwargs)
        kind.learn = functools.wraps(kind.learn)(learn)
if __name__ == "__main__":
    {caps}
    try:
        import cv2
        cv2.imshow = cv2.waitKey = lambda *args: 0
    except ImportError:
        pass
    del _cap
    _names = {{*globals()}}
"""
CAPS = {
    "original": """_cap("stable_baselines3.common.on_policy_algorithm", "OnPolicyAlgorithm")
    _cap("stable_baselines3.common.off_policy_algorithm", "OffPolicyAlgorithm")""",
    "rejeu": """_cap("rejeu.sb3.algorithms", "Original")""",
}
AFTER = """
if __name__ == "__main__":
    def _kind(value):
        if isinstance(value, (bool, int, float)) or getattr(value, "shape", 0) == ():
            return "number"
        if isinstance(value, type):
            return "class"
        kind, shape = type(value).__name__.replace("Tensor", "ndarray"), getattr(value, "shape", None)
        if isinstance(value, (list, tuple)) and len(value) < 9:
            return f"{{kind}} of {{', '.join(map(_kind, value))}}"
        return kind if shape is None else f"{{kind}} {{tuple(shape) if hasattr(shape, '__len__') else ''}}"
    import json as _json, types as _types
    _left = {{key: value for key, value in globals().items() if key not in _names and key[0] != "_"}}
    _left = {{key: _kind(value) for key, value in _left.items() if not isinstance(value, _types.ModuleType)}}
    _json.dump(_left, open({path!r}, "w"))
"""


def blocks_of(checkouts: list[Path]) -> dict[str, list[str]]:
    """Returns the blocks of each page."""
    pages = {}
    for checkout in checkouts:
        where = "contrib/" if (checkout / "sb3_contrib").is_dir() else ""
        for path in sorted(
            page for section in ("guide", "modules", "common") for page in checkout.glob(f"docs/{section}/*.md")
        ):
            blocks = [match[2] for match in FENCE.finditer(path.read_text(encoding="utf-8"))]
            pages[f"{where}{path.parent.name}/{path.stem}"] = [dedented(code) for code in blocks]
    return pages


def dedented(code: str) -> str:
    """Returns code without the indentation of its first line."""
    indent = len(code) - len(code.lstrip(" "))
    return re.sub(rf"(?m)^ {{1,{indent}}}", "", code) if indent else code


def run(code: str, library: str, python: str, packages: list[str], limit: float) -> dict[str, Any]:
    """Returns the error of code, None if it ran, and the names and files that it left."""
    for old, new in (*CHANGES, *(IMPORTS if library == "rejeu" else ())):
        code = re.sub(old, new, code)
    paths = [*([str(ROOT / "src")] if library == "rejeu" else []), *packages]
    variables = {
        "MPLBACKEND": "agg",
        "SDL_VIDEODRIVER": "dummy",
        "SDL_AUDIODRIVER": "dummy",
        "JAX_PLATFORMS": "cpu",
        "OMP_NUM_THREADS": "1",
    }
    variables |= {"PYTHONPATH": os.pathsep.join(paths), "WANDB_MODE": "disabled", "PYTHONWARNINGS": "ignore"}
    with tempfile.TemporaryDirectory() as folder:
        names_file, working_folder = Path(folder, "left.json"), Path(folder, "place")
        working_folder.mkdir()
        script = Path(folder, "block.py")
        text = BEFORE.format(caps=CAPS[library]) + code + AFTER.format(path=str(names_file))
        script.write_text(text, encoding="utf-8")
        try:
            done = subprocess.run(
                [python, str(script)], cwd=working_folder, env=os.environ | variables, capture_output=True, text=True,
                timeout=limit, check=False, stdin=subprocess.DEVNULL,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"error": f"takes more than {limit:.0f} s", "names": {}, "files": []}
        lines = [line for line in done.stderr.strip().splitlines() if re.match(ERROR, line)]
        error = None if not done.returncode else (lines or done.stderr.strip().splitlines() or ["no message"])[-1]
        files = sorted(
            {file_kind(path.relative_to(working_folder)) for path in working_folder.rglob("*") if path.is_file()}
        )
        names = json.loads(names_file.read_text(encoding="utf-8")) if names_file.is_file() else {}
    return {"error": error, "names": names, "files": files}


def file_kind(path: Path) -> str:
    """Returns the name of a file without what differs from run to run."""
    return re.sub(r"\d+(?=_steps)", "N", re.sub(r"events\.out.*", "events.out", path.as_posix()))


def class_of(error: str | None) -> str:
    """Returns the class of an error."""
    return (error or "").partition(":")[0].rpartition(".")[2]


def differences(original: dict[str, Any], ours: dict[str, Any]) -> list[str]:
    """Returns the differences between the names and files that two runs left, or their errors."""
    if class_of(original["error"]) != class_of(ours["error"]):
        return [f"{original['error'] or 'ran'} -> {ours['error'] or 'ran'}"]
    first, second = original["names"], ours["names"]
    names = [name for name in sorted({*first, *second}) if first.get(name) != second.get(name)]
    files = sorted({*original["files"]} ^ {*ours["files"]})
    return [f"{name}: {first.get(name)} -> {second.get(name)}" for name in names] + [f"file {name}" for name in files]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", type=Path, nargs="+", help="of stable-baselines3, and of sb3-contrib")
    parser.add_argument("--original", help="interpreter with the original")
    parser.add_argument("--packages", nargs="*", default=[], help="folders of packages that both find")
    parser.add_argument("--only", default="", help="an expression that is searched for in the names of blocks")
    parser.add_argument("--again", action="store_true", help="run the original again where its result is known")
    parser.add_argument("--join", nargs="*", type=Path, default=[], help="other results whose blocks are taken over")
    parser.add_argument("--limit", type=float, default=300, help="seconds that a block may take")
    parser.add_argument("--output", type=Path, default=RESULT)
    arguments = parser.parse_args()
    paths = [path for path in (arguments.output, *arguments.join) if path.is_file()]
    rows = {row["block"]: row for path in paths for row in json.loads(path.read_text(encoding="utf-8"))["blocks"]}
    for page, blocks in blocks_of(arguments.checkouts).items():
        ran: list[str] = []
        for number, block in enumerate(blocks, start=1):
            name = f"{page} {number}"
            row = rows.setdefault(name, {"block": name})
            row["torch"] = bool(re.search(TORCH, block))
            if arguments.original and re.search(arguments.only, name) and (arguments.again or "original" not in row):
                options: Any = ("original", arguments.original, arguments.packages, arguments.limit)
                row["original"], row["with_earlier"] = run(block, *options), False
                if "NameError" in (row["original"]["error"] or "") and ran:
                    row["original"], row["with_earlier"] = run("\n".join([*ran, block]), *options), True
            if "original" not in row:
                continue
            if not re.match(CANNOT, row["original"]["error"] or ""):
                code = "\n".join([*ran, block]) if row["with_earlier"] else block
                if re.search(arguments.only, name):
                    row["rejeu"] = run(code, "rejeu", sys.executable, arguments.packages, arguments.limit)
                    row["differs"] = differences(row["original"], row["rejeu"])
            if row["original"]["error"] is None:
                ran.append(block)
            if re.search(arguments.only, name):
                outcome = row["rejeu"]["error"] or "ran" if "rejeu" in row else "-"
                print(
                    f"{name} | {row['original']['error'] or 'ran'} | {outcome} | {row.get('differs', '')}", flush=True
                )
                record([*rows.values()], arguments)


def record(rows: list[dict[str, Any]], arguments: argparse.Namespace) -> None:
    """Writes the table."""
    names = {str(arguments.original): "PYTHON"} | dict.fromkeys(arguments.packages, "SITE_PACKAGES")
    names |= {str(path): name for path, name in zip(arguments.checkouts, ("CHECKOUT", "CONTRIB"), strict=False)}
    write(arguments.output, {**provenance(names), "blocks": [row for row in rows if "original" in row]}, rows="blocks")


if __name__ == "__main__":
    main()

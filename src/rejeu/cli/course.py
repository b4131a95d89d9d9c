"""``rejeu course``: the notebooks of the courses, written to a folder, and the grading of notebooks."""

from __future__ import annotations

from pathlib import Path

from rejeu.cli import jsonout
from rejeu.cli.commands import Course
from rejeu.courses import write


def run(arguments: Course) -> int:
    """Writes or grades notebooks, prints a line for each file, and returns the exit status."""
    if arguments.language == "grade":
        return grade(arguments)
    if len(arguments.paths) != 1:
        raise ValueError(f"rejeu course {arguments.language} needs one FOLDER, got {len(arguments.paths)}")
    written: list[Path] = []
    kept: list[Path] = []
    with jsonout.messages(arguments.json) as output:
        for path, is_new in write(arguments.language, arguments.paths[0]):
            (written if is_new else kept).append(path)
            change = "" if is_new else " exists and was not changed; delete or rename it to get a new copy"
            print(f"{path}{change}", flush=True)
        if arguments.json:
            jsonout.emit({"written": written, "kept": kept}, output)
    return 0


def grade(arguments: Course) -> int:
    """Prints which checks each notebook passes, and returns the exit status: 2 if a file could not be graded."""
    from rejeu.courses import grading

    grades = []
    with jsonout.messages(arguments.json) as output:
        for path in arguments.paths:
            one = grading.grade(path)
            grades.append(one)
            print(f"{path}: {one.error or f'{one.n_passed} of {len(one.found)} passed'}", flush=True)
            for name, found in one.found.items():
                if found != "" and not one.error:
                    print(f"  {name}: {found or 'its check did not run; is there an error in its cell?'}", flush=True)
        if arguments.json:
            jsonout.emit({"notebooks": [one._asdict() | {"passed": one.n_passed} for one in grades]}, output)
    return 2 if any(one.error for one in grades) else 0

'''Checks of a student's answers, which say what was seen and what to think about.

There is one module for each course, with a table (TOML) of the same name next to it. Most checks are a section of the table: a
small case, the right result and those of typical mistakes, each with its message in both languages::

    [td_error]
    case.q = [1.0, 2.0]
    case.target = [3.0, 1.0]
    right = [2.0, -1.0]  # target - q
    reversed.result = [-2.0, 1.0]  # q - target
    reversed.en = "The sign is reversed: ..."
    reversed.fr = "Le signe est inversé : ..."

The names of ``case`` are the arguments, in their order; text is the name of a function, which the module gives to
:func:`tabulated`. Comments say how results were computed. With ``compiles = true`` the arguments are arrays of JAX, and JAX
must be able to compile the student's function. With ``each = ["NAME"]`` the function is called once for each value of these
arguments. With ``gradient = true`` the gradient with respect to the first argument must not be 0. Other checks are functions::

    @exercise
    def td_error(student):
        """Checks ``td_error(q, target)``."""
        q, target = np.array([1.0, 2.0]), np.array([3.0, 1.0])
        diagnose(numbers(call(student, q, target), shape=(2,)), target - q, reversed=q - target)

A notebook says once in which language, then calls the checks, and asks for the answers that a cell needs::

    from rejeu.teaching.courses.checks import dqn_ppo as check, require, speak

    speak("en")
    check.td_error(td_error)  # prints one line, and returns whether it is right
    require("td_error")  # stops the notebook with one line unless the check has been passed
'''

from __future__ import annotations

import copy
import os
import sysconfig
import tomllib
import traceback
from collections.abc import Callable, Mapping
from functools import cache, wraps
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rejeu.core.language import SETTING, Language, chosen
from rejeu.core.types import JsonObject

NOT_STUDENTS = (Path(__file__).parents[3], Path(sysconfig.get_paths()["stdlib"]))
"""Folders whose code the student did not write, besides ``site-packages``."""
NOT_COMPILED = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
"""Errors of code that JAX cannot compile."""


Student = Callable[..., Any]
"""The function or class that a student wrote."""


class Wrong(Exception):
    """The student's answer is not right.

    Args:
        key: name of the message, which says what was seen. It is in the section of the exercise, or in ``[shared]``.
        values: what replaces the names in braces in the message.
    """

    def __init__(self, key: str, **values: object) -> None:
        super().__init__(key)
        self.key = key
        self.values = values


class NotReady(Exception):
    """A cell needs answers that are still missing. Notebooks show its message instead of a traceback."""

    def _render_traceback_(self) -> list[str]:
        return [str(self)]


class NotebookState:
    """The state of the checks in a notebook. Mutable."""

    def __init__(self) -> None:
        self.found: dict[str, str] = {}
        """Result of each check, by its name: nothing if the answer is right, else the message."""

    def say(self, key: str, course: str = "base", exercise: str = "shared", **values: object) -> str:
        """Returns a message in the language of the notebook.

        Args:
            key: name of the message.
            course: module of the checks.
            exercise: name of the check; messages of its course, and those of all courses, are found as well.
            values: what replaces the names in braces.
        """
        sections = (messages(course).get(exercise, {}), messages(course).get("shared", {}), messages("base")["shared"])
        text = next(section[key] for section in sections if key in section)
        return text[chosen()].format(**values)


SESSION = NotebookState()


@cache
def messages(course: str) -> dict[str, dict[str, JsonObject]]:
    """Returns the table of a course by exercise and name, from the file next to its module; messages are by language."""
    file = resources.files("rejeu.teaching.courses.checks") / f"{course}.toml"
    return tomllib.loads(file.read_text(encoding="utf-8"))


def speak(language: Language) -> None:
    """Sets the language of the messages, and of the windows of games, and forgets which checks have been passed.

    Raises:
        ValueError: for an unknown language.
    """
    os.environ[SETTING] = chosen(language)
    SESSION.found.clear()


class Verdict(int):
    """Whether an answer is right. A notebook does not display it: the check has printed its line."""

    def _ipython_display_(self) -> None:
        pass


def exercise(check: Callable[..., None]) -> Callable[..., Verdict]:
    """Makes a check of a function that raises :class:`Wrong`: it prints one line and returns whether the answer is right."""
    name, course = check.__name__, check.__module__.rpartition(".")[2]

    @wraps(check)
    def checked(*args: object, **kwargs: Any) -> Verdict:
        try:
            check(*args, **kwargs)
        except Wrong as error:
            message = SESSION.say(error.key, course, name, **error.values)
        except Exception as error:
            message = SESSION.say("unusable", what=f"{type(error).__name__}: {short(error)}")
        else:
            message = ""
        SESSION.found[name] = message
        print(SESSION.say("not_yet", name=name, found=message) if message else f"OK - {name}")
        return Verdict(not message)

    return checked


def tabulated(module: str, **functions: object) -> dict[str, Callable[..., Verdict]]:
    """Returns the checks that the table of a course describes, by name; see :mod:`rejeu.teaching.courses.checks`.

    ``functions`` are those that cases of the table name.
    """
    table = messages(module.rpartition(".")[2])
    return {name: of_table(name, module, section, functions) for name, section in table.items() if "case" in section}


def of_table(
    name: str, module: str, section: Mapping[str, Any], functions: Mapping[str, Any]
) -> Callable[..., Verdict]:
    """Returns the check of a section of a table."""
    each, is_compiled = section.get("each", ()), section.get("compiles", False)
    case = {key: functions[value] if isinstance(value, str) else value for key, value in section["case"].items()}
    case = {key: np.asarray(value) if isinstance(value, list) else value for key, value in case.items()}
    rows = zip(*(case[key] for key in each), strict=True)
    cases = [{**case, **dict(zip(each, row, strict=True))} for row in rows] if each else [case]
    wrong = {key: entry["result"] for key, entry in section.items() if isinstance(entry, dict) and "result" in entry}

    def check(student: Student) -> None:
        convert = lambda value: jnp.asarray(value) if is_compiled and hasattr(value, "dtype") else value  # noqa: E731
        inputs = [[*map(convert, case.values())] for case in cases]
        right = np.asarray(section["right"])
        results = [call(student, *arguments) for arguments in inputs]
        mistakes(**{key: np.shape(results[0]) == np.shape(mistake) != right.shape for key, mistake in wrong.items()})
        outputs = [numbers(result, right.shape[1:] if each else right.shape) for result in results]
        diagnose(np.stack(outputs) if each else outputs[0], right, **wrong)
        if is_compiled:
            compiles(student, *inputs[0])
        if section.get("gradient"):
            gradient = jax.tree.leaves(call(jax.grad(student), *inputs[0]))
            mistakes(no_gradient=all(close(leaf, np.zeros(leaf.shape)) for leaf in gradient))

    check.__name__, check.__module__ = name, module
    check.__doc__ = f"Checks ``{name}({', '.join(case)})``."
    return exercise(check)


def require(*names: str, **answers: object) -> None:
    """Stops the notebook with one line unless these checks have been passed.

    Args:
        *names: names of checks.
        **answers: values that must have replaced the ``...`` of the exercise, by their names.

    Raises:
        NotReady: if one has not.
    """
    missing = [name for name in names if SESSION.found.get(name, "not run")]
    missing += [name for name, value in answers.items() if value is ...]
    if missing:
        raise NotReady(SESSION.say("missing", names=", ".join(missing)))


def call(student: Student, *args: object, may_return_none: bool = False, copies: bool = True) -> Any:
    """Calls the student's function or class and returns the result.

    Args:
        student: what the student wrote.
        *args: arguments, of which it gets copies.
        may_return_none: whether ``None`` is right, as for a method that changes an object.
        copies: whether it gets copies of the arguments, which it must not change.

    Raises:
        Wrong: if it is not a function, raises an exception, changes its arguments, or returns ``None`` or ``...``.
    """
    if not callable(student):
        raise Wrong("not_a_function", what=short(student))
    arguments = copy.deepcopy(args) if copies else args
    try:
        result = student(*arguments)
    except (Exception, SystemExit) as error:
        problem, line = f"{type(error).__name__}: {short(error)}", line_of(error)
        raise Wrong("raises_in_line" if line else "raises", what=problem, line=line) from None
    if not _same(args, arguments):
        raise Wrong("changes_arguments")
    if (result is None and not may_return_none) or result is ...:
        raise Wrong("returns_nothing", what=short(result))
    return result


def compiles(student: Student, *args: object) -> None:
    """Checks that JAX can compile the student's function, as training does.

    Raises:
        Wrong: if it cannot, because of an ``if`` on an array or a function of NumPy.
    """
    try:
        jax.jit(student)(*args)
    except NOT_COMPILED as error:
        line = line_of(error)
        raise Wrong("not_compiled_line" if line else "not_compiled", line=line) from None


def numbers(result: object, shape: tuple[int, ...]) -> np.ndarray:
    """Returns a result as an array of floats of a shape, ``()`` for a number.

    Raises:
        Wrong: if it is not of numbers, not finite, or of another shape; an outer product by broadcasting is recognized.
    """
    try:
        array = np.asarray(result, float)
    except (TypeError, ValueError):
        raise Wrong("not_numbers", shape=shape, what=short(result)) from None
    n = shape[0] if shape else 0
    if n > 1 and array.shape == (n, n) != shape:
        raise Wrong("shape_of_pairs", seen=array.shape, shape=shape, n=n)
    if array.shape != shape:
        is_mean = shape == () and array.ndim == 1
        raise Wrong("shape_not_mean" if is_mean else "shape", seen=array.shape, shape=shape)
    if not np.isfinite(array).all():
        raise Wrong("not_finite", what=_rounded(array))
    return array


def diagnose(result: np.ndarray, right: ArrayLike, /, **wrong: ArrayLike) -> None:
    """Raises :class:`Wrong` unless a result is right, with the message of the first mistake whose result it is.

    Args:
        result: from :func:`numbers`.
        right: the right result.
        wrong: results of typical mistakes, by the name of the message.
    """
    if close(result, right):
        return
    for key, of_mistake in wrong.items():
        if close(result, of_mistake):
            raise Wrong(key)
    raise Wrong("by_hand", seen=_rounded(result), right=_rounded(right))


def mistakes(**occurred: object) -> None:
    """Raises :class:`Wrong` with the message of the first mistake that was seen.

    Args:
        occurred: whether each mistake was seen, by the name of its message.
    """
    for key, is_seen in occurred.items():
        if is_seen:
            raise Wrong(key)


def close(a: object, b: object) -> bool:
    """Returns whether two arrays have the same shape and, up to single precision, the same numbers."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-4, atol=1e-5))


def short(value: object) -> str:
    """Returns a value as text on one line of at most 160 characters."""
    text = "`...`" if value is ... else " ".join(str(value).split())
    return text if len(text) <= 160 else text[:157] + "..."


def line_of(error: BaseException) -> str:
    """Returns the innermost line of the student's code at which an error was raised, empty if it is unknown."""
    lines = [frame.line or "" for frame in traceback.extract_tb(error.__traceback__) if _is_students(frame.filename)]
    return lines[-1] if lines else ""


def _is_students(file: str) -> bool:
    """Returns whether a file belongs to no installed package: a cell of a notebook, or a script."""
    return "site-packages" not in file and not any(Path(file).is_relative_to(folder) for folder in NOT_STUDENTS)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    return True


def _rounded(values: object) -> str:
    return " ".join(np.array2string(np.asarray(values, float), precision=3, threshold=12, separator=", ").split())

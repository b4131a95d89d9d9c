"""What the checks of all courses share: languages, calling the student's code, comparing numbers."""

from __future__ import annotations

import copy
import sysconfig
import traceback
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from rejeu.courses.notebooks import LANGUAGES, Language

NOT_STUDENTS = (Path(__file__).parents[2], Path(sysconfig.get_paths()["stdlib"]))
"""Folders whose code the student did not write, besides ``site-packages``."""
NOT_COMPILED = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
"""Errors of code that JAX cannot compile."""


class Text(NamedTuple):
    """A message in every language."""

    en: str
    fr: str


class Wrong(Exception):
    """The student's answer is not right; the message says what was seen."""

    def __init__(self, en: str, fr: str) -> None:
        super().__init__(en)
        self.text = Text(en, fr)


class NotReady(Exception):
    """A cell needs answers that are still missing. Notebooks show its message instead of a traceback."""

    def _render_traceback_(self) -> list[str]:
        return [str(self)]


class Session:
    """The state of the checks in a notebook. Mutable."""

    def __init__(self) -> None:
        self.language: Language = "en"
        self.passed: set[str] = set()

    def say(self, text: Text) -> str:
        """Returns a text in the language of the notebook."""
        return text.fr if self.language == "fr" else text.en


SESSION = Session()


def speak(language: Language) -> None:
    """Sets the language of the messages, and forgets which checks have been passed.

    Raises:
        ValueError: for an unknown language.
    """
    if language not in LANGUAGES:
        raise ValueError(f"language {language!r} must be one of {', '.join(LANGUAGES)}")
    SESSION.language = language
    SESSION.passed.clear()


class Verdict(int):
    """Whether an answer is right. A notebook does not display it: the check has printed its line."""

    def _ipython_display_(self) -> None:
        pass


def exercise(check: Callable[..., None]) -> Callable[..., Verdict]:
    """Makes a check of a function that raises :class:`Wrong`: it prints one line and returns whether the answer is right."""
    name = check.__name__

    @wraps(check)
    def checked(*args: Any, **kwargs: Any) -> Verdict:
        try:
            check(*args, **kwargs)
        except Exception as error:
            text = error.text if isinstance(error, Wrong) else _unusable(error)
            SESSION.passed.discard(name)
            print(f"{SESSION.say(Text('Not yet', 'Pas encore'))} - {name}{_colon()} {SESSION.say(text)}")
            return Verdict(False)
        SESSION.passed.add(name)
        print(f"OK - {name}")
        return Verdict(True)

    return checked


def _unusable(error: Exception) -> Text:
    """Returns what to say if an answer is of a kind that the check cannot even look at."""
    what = f"{type(error).__name__}: {_short(error)}"
    return Text(
        f"the check cannot use your answer ({what}). Is it of the kind that the exercise asks for?",
        f"la vérification ne peut pas utiliser votre réponse ({what}). Est-elle de la sorte que demande l'exercice ?",
    )


def require(*names: str) -> None:
    """Stops the notebook with one line unless these checks have been passed.

    Raises:
        NotReady: if one has not.
    """
    missing = [name for name in names if name not in SESSION.passed]
    if missing:
        listed = ", ".join(missing)
        raise NotReady(
            SESSION.say(
                Text(
                    f"This cell needs your {listed}: complete it above and run its check first.",
                    f"Cette cellule a besoin de votre réponse à {listed} : complétez-la plus haut et lancez d'abord sa "
                    "vérification.",
                )
            )
        )


def call(student: Any, *args: Any, may_return_none: bool = False, copies: bool = True) -> Any:
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
        raise Wrong(
            f"a function was expected, not {_short(student)}.", f"il faut une fonction, et non {_short(student)}."
        )
    given = copy.deepcopy(args) if copies else args
    try:
        result = student(*given)
    except (Exception, SystemExit) as error:
        what, where = f"{type(error).__name__}: {_short(error)}", _line(error)
        raise Wrong(
            f"your code raises {what}{where and f' in the line: {where}'}",
            f"votre code lève {what}{where and f' à la ligne : {where}'}",
        ) from None
    if not _same(args, given):
        raise Wrong(
            "the result may be right, but your function changes the arrays it was given. Compute new ones: the "
            "caller still needs the old ones.",
            "le résultat est peut-être juste, mais votre fonction modifie les tableaux reçus. Calculez-en de "
            "nouveaux : l'appelant a encore besoin des anciens.",
        )
    if (result is None and not may_return_none) or result is ...:
        raise Wrong(
            f"it returns {_short(result)}. Replace the ... by your code, and do not forget return.",
            f"elle renvoie {_short(result)}. Remplacez les ... par votre code, et n'oubliez pas return.",
        )
    return result


def compiles(student: Any, *args: Any) -> None:
    """Checks that JAX can compile the student's function, as training does.

    Raises:
        Wrong: if it cannot, because of an ``if`` on an array or a function of NumPy.
    """
    try:
        jax.jit(student)(*args)
    except NOT_COMPILED as error:
        line = _line(error)
        raise Wrong(
            "the numbers are right, but JAX cannot compile the function for training. Use jnp instead of np, and jnp.where "
            f"instead of if{line and f': {line}'}",
            "les nombres sont justes, mais JAX ne peut pas compiler la fonction pour l'entraînement. Utilisez jnp au lieu de "
            f"np, et jnp.where au lieu de if{line and f' : {line}'}",
        ) from None


def numbers(result: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Returns a result as an array of floats of a shape, ``()`` for a number.

    Raises:
        Wrong: if it is not of numbers, not finite, or of another shape; an outer product by broadcasting is recognized.
    """
    try:
        array = np.asarray(result, float)
    except (TypeError, ValueError):
        raise Wrong(
            f"numbers of shape {shape} were expected, not {_short(result)}.",
            f"il faut des nombres de forme {shape}, et non {_short(result)}.",
        ) from None
    n = shape[0] if shape else 0
    if n > 1 and array.shape == (n, n) != shape:
        raise Wrong(
            f"the shape is {array.shape}, expected {shape}. A column of shape ({n}, 1) and a row of shape ({n},) "
            "were combined: NumPy and JAX then combine every element with every other one. Print the shapes of "
            "both, and remove the extra axis.",
            f"la forme est {array.shape} au lieu de {shape}. Une colonne de forme ({n}, 1) et une ligne de forme "
            f"({n},) ont été combinées : NumPy et JAX combinent alors chaque élément avec tous les autres. Affichez "
            "les deux formes et supprimez l'axe en trop.",
        )
    if array.shape != shape:
        mean = shape == () and array.ndim == 1
        raise Wrong(
            f"the shape is {array.shape}, expected {shape}" + (": one number, such as a mean." if mean else "."),
            f"la forme est {array.shape} au lieu de {shape}"
            + (" : il faut un seul nombre, par exemple une moyenne." if mean else "."),
        )
    if not np.isfinite(array).all():
        raise Wrong(
            f"the result is not finite: {_rounded(array)}. Is there a division by 0, or the logarithm of 0?",
            f"le résultat n'est pas fini : {_rounded(array)}. Y a-t-il une division par 0, ou le logarithme de 0 ?",
        )
    return array


def diagnose(result: np.ndarray, right: Any, *mistakes: tuple[Any, Text]) -> None:
    """Raises :class:`Wrong` unless a result is right, with the text of the first mistake whose result it is.

    Args:
        result: from :func:`numbers`.
        right: the right result.
        mistakes: results of typical mistakes, and what to say about them.
    """
    if close(result, right):
        return
    for wrong, text in mistakes:
        if close(result, wrong):
            raise Wrong(*text)
    raise Wrong(
        f"in a small case it gives {_rounded(result)}, but by hand one finds {_rounded(right)}. Compare your code "
        "with the equation, term by term.",
        f"dans un petit cas, elle donne {_rounded(result)}, alors qu'à la main on trouve {_rounded(right)}. Comparez "
        "votre code à l'équation, terme à terme.",
    )


def close(a: Any, b: Any) -> bool:
    """Returns whether two arrays have the same shape and, up to single precision, the same numbers."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-4, atol=1e-5))


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    return True


def _line(error: BaseException) -> str:
    """Returns the innermost line of the student's code at which an error was raised, empty if it is unknown."""
    lines = [frame.line or "" for frame in traceback.extract_tb(error.__traceback__) if _is_students(frame.filename)]
    return lines[-1] if lines else ""


def _is_students(file: str) -> bool:
    """Returns whether a file belongs to no installed package: a cell of a notebook, or a script."""
    return "site-packages" not in file and not any(Path(file).is_relative_to(folder) for folder in NOT_STUDENTS)


def _short(value: Any) -> str:
    text = "..." if value is ... else " ".join(str(value).split())
    return text if len(text) <= 160 else text[:157] + "..."


def _rounded(values: Any) -> str:
    return " ".join(np.array2string(np.asarray(values, float), precision=3, threshold=12, separator=", ").split())


def _colon() -> str:
    return "\N{NO-BREAK SPACE}:" if SESSION.language == "fr" else ":"

'''Checks of a student's answers, which say what was seen and what to think about.

There is one module for each course, with a table (TOML) of the same name next to it. Most checks are a section of the table: a
small case, the right result and those of typical mistakes, each with its message in both languages::

    [td_error]
    case.q = [1.0, 2.0]
    case.target = [3.0, 1.0]
    right = "target - q"
    reversed.result = "q - target"
    reversed.en = "The sign is reversed: ..."
    reversed.fr = "Le signe est inversé : ..."

The names of ``case`` are the arguments, in their order. Text is an expression in NumPy (``np``), and ``where.NAME`` names a
part of several. With ``compiles = true`` the arguments are arrays of JAX, and JAX must be able to compile the student's
function. With ``each = "NAME"`` the function is called once for each value of that argument. Other checks are functions::

    @exercise
    def td_error(student):
        """Checks ``td_error(q, target)``."""
        q, target = np.array([1.0, 2.0]), np.array([3.0, 1.0])
        diagnose(numbers(call(student, q, target), shape=(2,)), target - q, reversed=q - target)

A notebook says once in which language, then calls the checks, and asks for the answers that a cell needs::

    from rejeu.courses.checks import dqn_ppo as check, require, speak

    speak("en")
    check.td_error(td_error)  # prints one line, and returns whether it is right
    require("td_error")  # stops the notebook with one line unless the check has been passed
'''

from rejeu.courses.checks.base import (
    Wrong,
    call,
    close,
    compiles,
    diagnose,
    exercise,
    mistakes,
    numbers,
    require,
    speak,
    tabulated,
)

__all__ = [
    "Wrong",
    "call",
    "close",
    "compiles",
    "diagnose",
    "exercise",
    "mistakes",
    "numbers",
    "require",
    "speak",
    "tabulated",
]

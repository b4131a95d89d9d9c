'''Checks of a student's answers, which say what was seen and what to think about.

There is one module for each course, with a table of messages (TOML) of the same name next to it. A check is a function that
gets what the student wrote, runs it on a small case and compares the result with the right one and with those of typical
mistakes, by the names of their messages::

    @exercise
    def td_error(student):
        """Checks ``td_error(q, target)``."""
        q, target = np.array([1.0, 2.0]), np.array([3.0, 1.0])
        diagnose(numbers(call(student, q, target), shape=(2,)), target - q, reversed=q - target)

and the table holds::

    [td_error]
    reversed.en = "The sign is reversed: ..."
    reversed.fr = "Le signe est inversé : ..."

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
)

__all__ = ["Wrong", "call", "close", "compiles", "diagnose", "exercise", "mistakes", "numbers", "require", "speak"]

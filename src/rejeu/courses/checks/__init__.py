'''Checks of a student's answers, which say what was seen and what to think about.

There is one module for each course. Its checks are functions that get what the student wrote, run it on a small case and
raise :class:`Wrong` with a text in every language if the result is not right::

    @exercise
    def td_error(student):
        """Checks ``td_error(q, target)``."""
        q, target = np.array([1.0, 2.0]), np.array([3.0, 1.0])
        result = numbers(call(student, q, target), shape=(2,))
        diagnose(
            result,
            target - q,
            (q - target, Text("The sign is reversed: ...", "Le signe est inversé : ...")),
        )

A notebook says once in which language, then calls the checks, and asks for the answers that a training needs::

    from rejeu.courses.checks import dqn_ppo as check, require, speak

    speak("en")
    check.td_error(td_error)  # prints one line, and returns whether it is right
    require("td_error")  # stops the notebook with one line unless the check has been passed
'''

from rejeu.courses.checks.base import Text, Wrong, call, close, compiles, diagnose, exercise, numbers, require, speak

__all__ = ["Text", "Wrong", "call", "close", "compiles", "diagnose", "exercise", "numbers", "require", "speak"]

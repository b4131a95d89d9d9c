"""Training loops that run on the device: environments in JAX, replay buffer and updates in one compiled program.

A *chunk* of turns is one call of the program. Between chunks, :class:`rejeu.loops.run.Run` holds all that the loops of the
host would have left there, so callbacks, evaluation, checkpoints and files do not differ; steps of experience are copied there
when ``Run.replay`` is read. Results do not depend on where a chunk ends.
"""

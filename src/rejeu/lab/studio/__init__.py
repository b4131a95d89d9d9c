"""The studio: runs to start, watch, play against and compare in the web browser, served to this computer only.

:mod:`~rejeu.lab.studio.server` serves, :mod:`~rejeu.lab.studio.layout` is what all pages share, and each page is a module with
a function ``build`` in :data:`rejeu.lab.studio.server.PAGES`. Everything in a run folder is untrusted; its texts stay text.
"""

"""How fast rejeu is, beside its peers and beside what the machine allows: ``scripts/bench``, and the page it writes."""

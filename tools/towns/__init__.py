"""Plans of the bundled towns and what draws them: used by make_towns.py, not shipped."""

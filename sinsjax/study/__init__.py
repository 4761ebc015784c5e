"""Studies: what runs are made, with which motion, sensors, methods and settings.

It takes a TOML file or tables, checks every section, key and rule between them before anything
runs, and gives a `Study`: its sections with all defaults, and the variants and draws that they
span. The engine turns it into arrays, execution runs it, and reports name their numbers by it.
"""

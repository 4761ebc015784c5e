"""Studies, manifests and records that nobody would write, made from the schema to be read.

What reads them takes them, or raises `InputError` with one line that names the file, and the key or
the row: never another error, never a long wait, never much memory. `hypothesis` makes the cases and
makes those that fail small; `targets` has what is done with them.
"""

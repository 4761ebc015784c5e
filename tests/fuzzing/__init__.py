"""Random studies, manifests and records from the schema, as input of readers.

Readers accept them, or raise `InputError` with one line that names the file, and the key or the
row: no other error, no long wait, little memory. `hypothesis` generates the cases and reduces those
that fail; `targets` has the readers.
"""

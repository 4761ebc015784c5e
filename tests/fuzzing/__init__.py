"""Random studies and records from the schema, as input of readers.

Readers accept them, or raise `InputError` with one line that names the file, and the key or the
row: no other error, no long wait, little memory. `targets` has the readers.
"""

"""A study carried out: tasks, tables, directories that survive, and workers."""

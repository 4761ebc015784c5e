"""Running studies: tasks, result tables, resumable results directories, and workers."""

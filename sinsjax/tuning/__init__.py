"""A study tuned: its variables searched on some draws, what was found judged on others.

`objective` is what is made small, `search` looks at points of a grid or of a sequence, `history`
keeps what was looked at, `carry_out` does all that a study's [tune] asks for.
"""

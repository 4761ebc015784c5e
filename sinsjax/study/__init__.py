"""Studies: files, keys, rules, variants and draws."""

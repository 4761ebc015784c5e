"""The machine underneath: compiler options, devices, cores and files."""

"""The platform that studies run on: compiler options, devices, cores and files."""

"""The platform: this machine and process, its compiler options, and files.

It takes environment variables and facts of the system, and gives a JAX that is set up for runs
of double precision, facts for manifests, and files that are written whole or not at all.
"""

"""The platform: this machine and process, its compiler options, and files.

It takes environment variables and what the system tells, and gives a JAX that is set up for runs
of double precision, facts for manifests, and files that are written whole or not at all.
"""

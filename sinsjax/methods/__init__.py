"""Alignment methods: pure functions of one run, one folder a method."""

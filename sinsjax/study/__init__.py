"""A study: what its file may say, checked, and the variants and draws that it spans."""

"""One-line faults of the package, and the script that checks that tests notice each of them."""

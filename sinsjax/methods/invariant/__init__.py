"""Zero-velocity alignment by a right-invariant filter: the group's own error and feedback."""

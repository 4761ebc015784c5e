"""Small studies and directories of results that several tests share."""

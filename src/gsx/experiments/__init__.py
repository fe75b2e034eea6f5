"""Many runs at once: the tables of the paper, planned so that what runs share is trained once."""

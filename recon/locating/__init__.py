"""Where a photograph that was not in the set was taken, in a finished scene; or why that cannot be said."""

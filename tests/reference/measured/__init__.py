"""The tables and figures of the pages that tell what was measured, from the raw files of tests/bench/results/."""

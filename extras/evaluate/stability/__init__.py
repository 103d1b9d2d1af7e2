"""The stability matrix: sets of photographs that break reconstructions, and whether the answer was right each time.

A row is a function that makes a case of a place and a seed (families in the files named after them, found by
`campaign`); `trial` runs it through the public entry point, compares the answer with the truth, and judges it;
`campaign` does so with many, each in a process of its own, counts, and is the verb. `windows` chooses windows of
consecutive photographs from scenes with true cameras and judges answers; `window_campaign` runs what is missing.
"""

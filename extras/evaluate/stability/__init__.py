"""The stability matrix: sets of photographs that break reconstructions, and whether the answer was right each time.

A row is a function that makes a case of a place and a seed (families in the files named after them, found by
`matrix`); `trial` runs it through the public entry point and judges the answer; `campaign` does so with many, each in a
process of its own; `outcome` compares the answer with the truth; `summary` counts; `command` is the verb.
"""

"""Windows of consecutive photographs from scenes with true cameras: which answers are right, and what claims are worth.

`window` chooses them; `ours` and `rivals` answer them, with what was matched in a scene kept for all of its windows;
`row` is one answer compared with the truth; `campaign` runs what is missing; `summary` counts; `command` is the verb.
"""

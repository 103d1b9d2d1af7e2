"""Windows of consecutive photographs from scenes with true cameras: which answers are right, and what claims are worth.

`window` chooses them; `ours` and `rivals` answer one each, in a process of its own; what they find in a scene is kept
for its further windows: `turns` hands it on, `store` tells what it is. `row` is one answer compared with the truth;
`campaign` runs what is missing; `summary` counts; `command` is the verb.
"""

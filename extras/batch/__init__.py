"""Many recordings, each reconstructed by a process of its own; what fails costs only itself.

`sources` finds the recordings, `engine` runs their commands (any commands: it knows nothing of reconstruction),
`ledger` writes down each end as it comes, `answer` reads what a result says, `tables` and `page` show them all;
`command` is the verb. It runs without torch.
"""

"""How the three processes talk: acknowledged keyframes, previews and heartbeats that may drop, states for late comers.

services.py is the table of what is spoken, network.py how it is reached, wire.py what a message looks like. On top of
them stand keyframes.py (nothing is lost), broadcast.py (newest wins), state.py (newest wins, and late comers get it)
and commands.py (a question and its answer). A socket belongs to the thread that made it.
"""

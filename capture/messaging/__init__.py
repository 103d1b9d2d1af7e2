"""The three processes' messages over ZeroMQ: keyframes, previews, heartbeats, scenes and commands.

services.py is the table of services, network.py opens their sockets, wire.py encodes messages. The patterns on top are
keyframes.py (acknowledged, nothing is lost), broadcast.py (PUB/SUB, the newest counts), state.py (the same, and a late
subscriber gets the last one) and commands.py (request and reply). A socket belongs to the thread that made it.
"""

"""The three processes' messages over ZeroMQ: keyframes, previews, heartbeats, scenes and commands.

network.py has the table of services and opens their sockets, messages.py encodes messages. The patterns on top are
keyframe_queue.py (acknowledged, nothing is lost) and pubsub.py: broadcast (the newest counts), state (the same, and a
late subscriber gets the last one) and commands (request and reply). A socket belongs to the thread that made it.
"""

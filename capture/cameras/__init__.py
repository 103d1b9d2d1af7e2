"""One file a source, each with `Config`, `stream(config)` and, for devices, `find()`.

A source that cannot be used, at first or later, raises CameraUnavailable. One that sets LIVE = True goes on whether or
not anybody reads: the newest frames are read then. Its frames' stamps are the monotonic clock's.
`captured_at` says when a frame was captured, and by which clock; None where the source does not tell.
"""

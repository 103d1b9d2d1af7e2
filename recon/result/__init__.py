"""What a reconstruction gives: snapshot, verdict, report, pictures, messages, files. It runs without torch."""

"""What a restarted daemon goes on from: keyframes, view graph, estimate and scene on disk."""

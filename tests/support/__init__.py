"""What tests share: synthetic scenes, nodes of real processes, crafted results, virtual screens."""

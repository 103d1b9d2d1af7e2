"""The process that `probe` watches: opens a small window, and says so."""

import os


def main() -> None:
    """Ends this process."""
    from open3d.visualization import gui, rendering  # pyright: ignore[reportMissingImports]

    app = gui.Application.instance
    app.initialize()
    window = app.create_window("splatnode", 64, 64)
    widget = gui.SceneWidget()
    widget.scene = rendering.Open3DScene(window.renderer)
    window.add_child(widget)
    for _ in range(3):
        app.run_one_tick()
    print("splatnode-window-opened", flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()

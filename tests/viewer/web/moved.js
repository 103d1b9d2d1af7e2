async (view) => {
  const { orbited, panned, zoomed, fitted, projected } = await import("/viewpoint.js");
  const lens = fitted(view.lens, 640, 480);
  return {
    orbited: orbited(view, 0.3, -0.2),
    high: orbited(view, 0.0, 3.0),
    panned: panned(view, 12.0, -7.0, lens.fx),
    zoomed: zoomed(view, 0.7),
    fitted: lens,
    projected: projected([0.3, 0.2, 0.9], view.T, lens),
  };
}

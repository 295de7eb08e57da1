"use strict";
// Where a camera's image shows a point before it: the equations of alpasim_plugin/cameras/lens.py. Points are metres right, down, forward.

const NEAR_M = 0.4, STEPS = 60;

// Coefficients from the constant upwards.
const polynomial = (coefficients, x) => coefficients.reduceRight((sum, coefficient) => sum * x + coefficient, 0);

// The x in [0, high] with polynomial(x) = value, where the polynomial grows.
function solved(coefficients, value, high) {
  let low = 0;
  for (let step = 0; step < STEPS; step += 1) {
    const middle = (low + high) / 2;
    if (polynomial(coefficients, middle) < value) low = middle; else high = middle;
  }
  return (low + high) / 2;
}

// A point at unit depth after OpenCV's rational, tangential and thin prism terms.
function distorted(terms, x, y) {
  const [k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4] = [...terms, ...Array(12 - terms.length).fill(0)], r2 = x * x + y * y;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [
    x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2 * r2,
    y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2 * r2,
  ];
}

// A point's place about the lens's middle, before its focal lengths; null where the lens model describes nothing.
const PLACES = {
  pinhole: (lens, [x, y, z]) => (z < NEAR_M * (1 - 1e-9) ? null : [x / z, y / z]),

  opencv({ terms, reach }, [x, y, z]) {
    return z > 1e-3 && Math.hypot(x / z, y / z) < reach.slope ? distorted(terms, x / z, y / z) : null;
  },

  fisheye({ terms, reach }, [x, y, z]) {
    const across = Math.hypot(x, y), angle = Math.atan2(across, z);
    if (angle > reach.angle_rad) return null;
    const share = angle * polynomial([1, ...terms], angle * angle) / Math.max(across, 1e-12);
    return [share * x, share * y];
  },

  ftheta({ terms, inverse, linear: [c, d, e], reach }, [x, y, z]) {
    const across = Math.hypot(x, y), angle = Math.atan2(across, z);
    if (angle > reach.angle_rad) return null;
    const radius = inverse.length ? solved(inverse, angle, reach.radius_px) : polynomial(terms, angle), share = radius / Math.max(across, 1e-12);
    return [share * (c * x + d * y), share * (e * x + y)];
  },
};

// The pixel of a point; null where the camera shows nothing of it.
function pixelOf(lens, point) {
  const place = PLACES[lens.kind](lens, point);
  if (!place) return null;
  const [fx, fy, cx, cy] = lens.k, [u, v] = lens.kind === "ftheta" ? place : [fx * place[0], fy * place[1]];
  return [lens.scale * (u + cx), lens.scale * (v + cy)];
}

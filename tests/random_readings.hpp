// Random readings of sensors, some of which are bad.
#pragma once
#include <math.h>
#include <stdint.h>

static uint64_t state = 1;
inline double uniform() {
  state = state * 6364136223846793005u + 1442695040888963407u;
  return (double)(state >> 11) / 9007199254740992.0;
}
// A component of about a size, and sometimes NaN, infinite, zero or of any size.
template <class Real>
Real component(double size) {
  const double kind = uniform();
  if (kind < 0.002) return (Real)NAN;
  if (kind < 0.003) return (Real)INFINITY;
  if (kind < 0.005) return 0;
  if (kind < 0.01) return (Real)pow(10.0, 80.0 * uniform() - 40.0);
  return (Real)(size * (2.0 * uniform() - 1.0));
}

// The time of the next reading after a time: usually soon, sometimes before it, much later, or no number.
inline double next_time(double time, double usual_s) {
  const double kind = uniform();
  if (kind > 0.9999) return INFINITY;
  if (kind > 0.9998) return NAN;
  if (kind < 0.9) return time + usual_s * uniform();
  if (kind < 0.95) return time - uniform();
  return time + (kind < 0.99 ? 10.0 * uniform() : pow(10.0, 12.0 * uniform() - 6.0));
}

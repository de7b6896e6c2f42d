// Rows of readings from the standard input through the filter of satellite.hpp, which export-config wrote. Prints the
// status of each row, flags, attitude, rate, states, sigma, nis and the covariance.
#include <stdio.h>

#include "satellite.hpp"

#ifndef REAL
#define REAL double
#endif

int main() {
  static satellite::Filter<REAL> filter(satellite::config<REAL>());
  double time;
  while (scanf("%lf", &time) == 1) {
    REAL row[40];
    for (REAL &x : row) {
      double value;
      if (scanf("%lf", &value) != 1) return 1;
      x = (REAL)value;
    }
    adcs::OrbitPoint<REAL> at;
    for (int i = 0; i < 3; ++i)
      at.position_m[i] = row[i], at.velocity_m_s[i] = row[3 + i], at.field_T[i] = row[6 + i], at.sun[i] = row[9 + i];
    adcs::SatelliteReadings<REAL> now;
    now.star = row + 12, now.star_covariance_rad2 = row + 16, now.gyro_rad_s = row + 25, now.field_T = row + 28;
    now.sun = row + 31, now.wheels_Nms = row + 34, now.torquers_Am2 = row + 37;
    const adcs::Status status = filter.update(time, now, at);
    const auto &found = filter.estimate();
    printf("%d %u", (int)status, (unsigned)found.flags);
    for (REAL x : found.q) printf(" %.17g", (double)x);
    for (REAL x : found.rate) printf(" %.17g", (double)x);
    for (int i = 0; i < filter.n - 6; ++i) printf(" %.17g", (double)found.states[i]);
    for (REAL x : found.sigma) printf(" %.17g", (double)x);
    for (double x : found.nis) printf(" %.17g", x);
    for (int i = 0; i < filter.n; ++i)
      for (int j = 0; j < filter.n; ++j) printf(" %.17g", (double)filter.covariance(i, j));
    printf("\n");
  }
}

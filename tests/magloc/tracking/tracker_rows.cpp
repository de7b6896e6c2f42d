// Rows of four sensors from the standard input through the tracker of the example. Prints the status, components,
// position, moment, sigma and NIS of each.
#define main main_of_example
#include "hand_held_detector.cpp"
#undef main

int main() {
  tracker.start(detector());
  double time, rows[4][3];
  while (scanf("%lf", &time) == 1) {
    for (auto &row : rows)
      for (double &x : row)
        if (scanf("%lf", &x) != 1) return 1;
    const magloc::TrackerStatus status = tracker.update(time, rows);
    const auto &now = tracker.estimate();
    printf("%d %d", (int)status, now.components);
    for (double x : now.position_m) printf(" %.17g", x);
    for (double x : now.moment_Am2) printf(" %.17g", x);
    for (int i = 0; i < 6; ++i) printf(" %.17g", square_root(now.covariance[i][i]));
    printf(" %.17g\n", now.nis);
  }
}

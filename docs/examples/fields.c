/* The field of a dipole at two points, by the library of kernels. */
#include <magloc.h>
#include <stdio.h>

int main(void) {
  const double points[2][3] = {{0.0, 0.0, 1.0}, {0.5, 0.0, 0.0}};
  const double source[3] = {0.0, 0.0, 0.0}, moment[3] = {0.0, 0.0, 5.0};
  double fields[2][3], workspace[1];
  magloc_dipoles problem = {2, 1, points[0], source, moment, fields[0]};
  magloc_dipole_fields(&problem, 0, 2, workspace);
  for (int i = 0; i < 2; ++i)
    printf("%.17g %.17g %.17g\n", fields[i][0], fields[i][1], fields[i][2]);
  return 0;
}

/* Reads lines "x y z yaw pitch previous_roll" (m, rad), writes "status active q1 .. q6": no Python, no allocation. */
#include <math.h>
#include <stdio.h>

#include "cts_inverse.h"

int main(void) {
  static casadi_int iw[optimal_inverse_i1_SZ_IW + 1];
  static casadi_real w[optimal_inverse_i1_SZ_W + 1];
  const casadi_real *arg[optimal_inverse_i1_SZ_ARG];
  casadi_real *res[optimal_inverse_i1_SZ_RES];
  casadi_real in[6], joints[6], cost, active, status;

  while (scanf("%lf %lf %lf %lf %lf %lf", in, in + 1, in + 2, in + 3, in + 4, in + 5) == 6) {
    arg[0] = in;
    arg[1] = in + 5;
    res[0] = joints;
    res[1] = &cost;
    res[2] = &active;
    res[3] = &status;
    if (optimal_inverse_i1(arg, res, iw, w, 0)) return 1;
    printf("%d %d", (int)status, (int)active);
    for (int k = 0; k < 6; ++k) printf(" %.17g", joints[k]);
    printf("\n");
  }
  return 0;
}

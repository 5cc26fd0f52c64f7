/* A partially separable program as its stages: blocks in, matrices of stages out.

   The same text for every problem; sizes and places come in the tables that ocp/direct/native.py makes. What the solver
   sees is scaled: variables over `a`, rows and cost over their own. Here: the program and what no solver sees of it;
   riccati.c, stages.c and interior.c follow, in one text with this.

   The solver never sees the inner variables z of a stage, which the inner rows D(w, z) = 0 there define by the others,
   w = (u, x): the values at the points of an interval and its end. Newton's method finds z at each w. With E = dz/dw
   = -D_z^-1 D_w a row r has the slope r_w + r_z E; with the multipliers -D_z^-T L_z of the inner rows the Lagrangian L
   no longer moves with z, and the curvature is that of L along (1, E). */
#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define VAST 1e20
#define WILD (1 / DBL_EPSILON) /* derivatives beside which 1 is rounding */
#define SETTLED 1e-13 /* of the inner rows */
#define ROUNDING 1e-9 /* below which inner rows that fall no more stand at their rounding */
#define GAIN 0.1 /* of what is left, by a step with the factors of an earlier point: slower, and new ones are quicker */
#define STEPS DBL_MANT_DIG /* of Newton's method, and halvings of each, whose last changes nothing */
#define EXPORT __attribute__((visibility("default")))

enum { VALUE, GRADIENT, JACOBIAN, HESSIAN, KINDS };

/* Entries of the program's matrices: number `source` belongs at (row, column); those of stage k begin at first[k]. */
typedef struct {
  const int *first, *row, *column, *source;
} entries;

typedef struct {
  int stages, variables, rows, values, slopes, linear, equal, slacks; /* rows of the solver: equalities, inequalities */
  int plain, most;               /* no block reads an inner variable; variables of the largest stage */
  const int *nx, *nu, *nz, *ng, *ni; /* of each stage */
  const int *primal_first, *slack_first, *inner_first, *factors_first, *sensitivity_first; /* where its part begins */
  const int *place;              /* of each variable in the solver's vector; -1: an inner one */
  const int *local;              /* of each variable in its stage: controls, states, inner ones */
  const int *inner_variable, *inner_row; /* stage by stage */
  const double *a;
  const int *kind, *position;    /* of each row: 0 dynamics, 1 equality, 2 inequality, 3 inner; which in its stage */
  const int *target;             /* of each row in the solver's vector of rows; -1: not there */
  const double *factor, *shift;  /* of each row: sign over scale; what an equality is asked to be */
  entries constant, inner, jacobian, hessian; /* of linear rows; of inner rows, of others; of half the curvature */
  const double *half;            /* of each entry of the curvature: 1, on the diagonal 1/2 */
  double *numbers[KINDS];        /* of all blocks: costs and rows; slopes; entries of the Jacobian, of the Hessian */
  const int *value_row;          /* of each number of VALUE; -1: a cost */
  const int *slope_of;           /* of each number of GRADIENT the variable */
  double cost_scale;
  double *x, *g, *lam;           /* scratch: variables and rows as they are, multipliers of these */
  double sigma;
  const double *lower, *upper, *guess; /* of inequalities; in the solver's order */
  const int *own;                /* of each inequality the variable that it bounds, in the solver's order; -1: none */
  int (*evaluate)(int);          /* fills the numbers of a kind, at x, lam and sigma */
  int (*watch)(int);             /* not zero where the solve must end; told whether there is a new iterate */
  double cost, missed;           /* of it */
  double *seen, *before, *slope, *step, *size, *factors, *sensitivity, *scratch;
  int *pivots;
  int stopped;                   /* the solve must end */
  int known, found, ready, sloped, factored; /* of the point seen: its values, z; E, slopes; an E of some point */
} program;

static int wild(double v) { return !(fabs(v) < WILD); }

static double tame(double v) { return isnan(v) ? VAST : v > VAST ? VAST : v < -VAST ? -VAST : v; }

static int own(const program *s, int k) { return s->nu[k] + s->nx[k]; }

static int ends(program *s, int anew) {
  if (!s->stopped && s->watch(anew)) s->stopped = 1;
  return s->stopped;
}

static int must_end(program *s) { return ends(s, 0); }

/* ---- dense factors of D_z, row by row ---- */

static int factorised(double *m, int *pivot, int n) {
  int c, r, q;
  for (c = 0; c < n; ++c) {
    double best = fabs(m[c * n + c]);
    pivot[c] = c;
    for (r = c + 1; r < n; ++r)
      if (fabs(m[r * n + c]) > best) best = fabs(m[r * n + c]), pivot[c] = r;
    if (!(best > 0.0 && best < VAST)) return 0;
    if (pivot[c] != c)
      for (q = 0; q < n; ++q) {
        double kept = m[c * n + q];
        m[c * n + q] = m[pivot[c] * n + q], m[pivot[c] * n + q] = kept;
      }
    for (r = c + 1; r < n; ++r) {
      double f = m[r * n + c] /= m[c * n + c];
      if (f != 0.0)
        for (q = c + 1; q < n; ++q) m[r * n + q] -= f * m[c * n + q];
    }
  }
  return 1;
}

/* b (n, w) becomes -m^-1 b. */
static void solved(const double *m, const int *pivot, int n, double *b, int w) {
  int c, r, q;
  for (c = 0; c < n; ++c)
    if (pivot[c] != c)
      for (q = 0; q < w; ++q) {
        double kept = b[c * w + q];
        b[c * w + q] = b[pivot[c] * w + q], b[pivot[c] * w + q] = kept;
      }
  for (r = 1; r < n; ++r)
    for (c = 0; c < r; ++c)
      if (m[r * n + c] != 0.0)
        for (q = 0; q < w; ++q) b[r * w + q] -= m[r * n + c] * b[c * w + q];
  for (r = n - 1; r >= 0; --r) {
    for (c = r + 1; c < n; ++c)
      if (m[r * n + c] != 0.0)
        for (q = 0; q < w; ++q) b[r * w + q] -= m[r * n + c] * b[c * w + q];
    for (q = 0; q < w; ++q) b[r * w + q] /= m[r * n + r];
  }
  for (r = 0; r < n * w; ++r) b[r] = -b[r];
}

/* b (n) becomes -m^-T b. */
static void solved_transposed(const double *m, const int *pivot, int n, double *b) {
  int c, r;
  for (r = 0; r < n; ++r) {
    b[r] /= m[r * n + r];
    for (c = r + 1; c < n; ++c) b[c] -= m[r * n + c] * b[r];
  }
  for (r = n - 1; r > 0; --r)
    for (c = 0; c < r; ++c) b[c] -= m[r * n + c] * b[r];
  for (c = n - 1; c >= 0; --c)
    if (pivot[c] != c) {
      double kept = b[c];
      b[c] = b[pivot[c]], b[pivot[c]] = kept;
    }
  for (r = 0; r < n; ++r) b[r] = -b[r];
}

/* ---- inner variables ---- */

/* The rows at x; with the values of the blocks anew, or those at hand. */
static void rows_at(program *s, int anew) {
  const double *constant = s->numbers[JACOBIAN];
  const entries *e = &s->constant;
  int i;
  if (anew) s->evaluate(VALUE);
  memset(s->g, 0, sizeof(double) * (size_t)s->rows);
  for (i = 0; i < s->values; ++i)
    if (s->value_row[i] >= 0) s->g[s->value_row[i]] += s->numbers[VALUE][i];
  for (i = 0; i < s->linear; ++i) s->g[e->row[i]] += constant[e->source[i]] * s->x[e->column[i]];
}

/* The largest inner row of a stage. */
static double size_of(const program *s, int k) {
  double largest = 0.0;
  int i;
  for (i = s->inner_first[k]; i < s->inner_first[k + 1]; ++i)
    largest = fmax(largest, fabs(tame(s->factor[s->inner_row[i]] * s->g[s->inner_row[i]])));
  return largest;
}

static void walk(program *s, int k, double share) {
  int i;
  for (i = s->inner_first[k]; i < s->inner_first[k + 1]; ++i)
    s->x[s->inner_variable[i]] += share * s->step[i] * s->a[s->inner_variable[i]];
}

/* Newton's step of a stage with the factors at hand. */
static void step(program *s, int k) {
  const int first = s->inner_first[k];
  int i;
  for (i = first; i < s->inner_first[k + 1]; ++i) s->step[i] = s->factor[s->inner_row[i]] * s->g[s->inner_row[i]];
  solved(s->factors + s->factors_first[k], s->pivots + first, s->nz[k], s->step + first, 1);
  walk(s, k, 1.0);
}

static int settled(double size, double last) { return size <= SETTLED || (size <= ROUNDING && size >= last / 2); }

/* Factors of D_z, and D_w where E belongs, at x. */
static int factorise(program *s) {
  const entries *e = &s->inner;
  int i, k;
  s->factored = 0;
  s->evaluate(JACOBIAN);
  for (k = 0; k < s->stages; ++k) {
    const int n = s->nz[k], w = own(s, k);
    double *of_z = s->factors + s->factors_first[k], *of_w = s->sensitivity + s->sensitivity_first[k];
    memset(of_z, 0, sizeof(double) * (size_t)(n * n));
    memset(of_w, 0, sizeof(double) * (size_t)(n * w));
    for (i = e->first[k]; i < e->first[k + 1]; ++i) {
      const int r = s->position[e->row[i]], c = s->local[e->column[i]];
      const double v = s->numbers[JACOBIAN][e->source[i]] * s->factor[e->row[i]] * s->a[e->column[i]];
      if (c < w) of_w[r * w + c] += v;
      else of_z[r * n + c - w] += v;
    }
    if (!factorised(of_z, s->pivots + s->inner_first[k], n)) return 0;
  }
  return 1;
}

/* Inner variables beside those of the point of E, with its factors; 0 where that does not lead there. */
static int beside(program *s) {
  double last = VAST;
  int i, j, k, q, count;
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k);
    const double *along = s->sensitivity + s->sensitivity_first[k];
    double *moved = s->scratch;
    for (q = 0; q < w; ++q) moved[q] = s->seen[s->primal_first[k] + q] - s->before[s->primal_first[k] + q];
    for (j = 0, i = s->inner_first[k]; i < s->inner_first[k + 1]; ++i, ++j) {
      double sum = s->before[s->primal_first[s->stages] + i];
      for (q = 0; q < w; ++q) sum += along[j * w + q] * moved[q];
      s->x[s->inner_variable[i]] = sum * s->a[s->inner_variable[i]];
    }
  }
  for (count = 0;; ++count) { /* what is left becomes nothing, or falls no more */
    double size = 0.0;
    rows_at(s, !count || !s->plain);
    for (k = 0; k < s->stages; ++k) size = fmax(size, size_of(s, k));
    if (settled(size, last)) return 1;
    if (!(size < GAIN * last)) return 0;
    last = size;
    for (k = 0; k < s->stages; ++k) step(s, k);
  }
}

/* Inner variables by Newton's method from the last ones that were found, each stage with a step of its own. */
static int newton(program *s) {
  int i, k, count, halving, left, worse;
  for (i = 0; i < s->inner_first[s->stages]; ++i)
    s->x[s->inner_variable[i]] = s->before[s->primal_first[s->stages] + i] * s->a[s->inner_variable[i]];
  rows_at(s, 1);
  for (k = 0; k < s->stages; ++k) s->size[k] = size_of(s, k) <= SETTLED ? -1.0 : size_of(s, k);
  for (count = 0; count < STEPS; ++count) {
    for (left = k = 0; k < s->stages; ++k) left |= s->size[k] >= 0.0;
    if (!left) return 1;
    if (must_end(s) || !factorise(s)) return 0;
    for (k = 0; k < s->stages; ++k)
      if (s->size[k] >= 0.0) step(s, k);
    for (halving = 0, worse = 1; worse && halving < STEPS; ++halving) {
      rows_at(s, !s->plain);
      for (worse = k = 0; k < s->stages; ++k) {
        if (s->size[k] < 0.0 || size_of(s, k) <= fmax(ROUNDING, (1.0 - 1e-4) * s->size[k])) continue;
        for (i = s->inner_first[k]; i < s->inner_first[k + 1]; ++i) s->step[i] /= 2;
        walk(s, k, -1.0);
        worse = 1;
      }
    }
    if (worse) return 0;
    for (k = 0; k < s->stages; ++k)
      if (s->size[k] >= 0.0) s->size[k] = settled(size_of(s, k), s->size[k]) ? -1.0 : size_of(s, k);
  }
  return 0;
}

/* The variables of the program at the solver's, and the values of the blocks there; not twice at the same place. */
static int move(program *s, const double *primal) {
  int i;
  if (s->known && !memcmp(s->seen, primal, sizeof(double) * (size_t)s->primal_first[s->stages])) return s->found;
  memcpy(s->seen, primal, sizeof(double) * (size_t)s->primal_first[s->stages]);
  for (i = 0; i < s->variables; ++i)
    if (s->place[i] >= 0) s->x[i] = primal[s->place[i]] * s->a[i];
  s->known = 1;
  s->ready = s->sloped = 0;
  if (s->inner_first[s->stages]) return s->found = (s->factored && beside(s)) || newton(s);
  rows_at(s, 1);
  return s->found = 1;
}

/* The entries of the Jacobian and E there, of which later points are sought beside. */
static int slopes_at(program *s, const double *primal) {
  int i, k;
  if (!move(s, primal)) return 0;
  if (s->ready) return 1;
  if (!factorise(s)) return 0;
  for (k = 0; k < s->stages; ++k)
    solved(s->factors + s->factors_first[k], s->pivots + s->inner_first[k], s->nz[k],
           s->sensitivity + s->sensitivity_first[k], own(s, k));
  memcpy(s->before, primal, sizeof(double) * (size_t)s->primal_first[s->stages]);
  for (i = 0; i < s->inner_first[s->stages]; ++i)
    s->before[s->primal_first[s->stages] + i] = s->x[s->inner_variable[i]] / s->a[s->inner_variable[i]];
  return s->ready = s->factored = 1;
}

/* The slope of the cost in all variables, inner ones among them. */
static void slope_of_cost(program *s) {
  int i;
  if (s->sloped) return;
  s->evaluate(GRADIENT);
  memset(s->slope, 0, sizeof(double) * (size_t)s->variables);
  for (i = 0; i < s->slopes; ++i)
    s->slope[s->slope_of[i]] += tame(s->numbers[GRADIENT][i]) * s->a[s->slope_of[i]] / s->cost_scale;
  s->sloped = 1;
}

/* Multipliers of all rows, of the inner ones those with which the Lagrangian does not move with inner variables. */
static void multipliers(program *s, double scale, const double *dual) {
  const entries *e = &s->jacobian;
  int i, k;
  slope_of_cost(s);
  for (i = 0; i < s->rows; ++i) s->lam[i] = s->target[i] < 0 ? 0.0 : s->factor[i] * dual[s->target[i]];
  for (k = 0; k < s->stages; ++k) {
    const int first = s->inner_first[k], w = own(s, k);
    double *push = s->step + first;
    for (i = first; i < s->inner_first[k + 1]; ++i) push[i - first] = scale * s->slope[s->inner_variable[i]];
    for (i = e->first[k]; i < e->first[k + 1]; ++i)
      if (s->local[e->column[i]] >= w)
        push[s->local[e->column[i]] - w] +=
            tame(s->numbers[JACOBIAN][e->source[i]]) * s->lam[e->row[i]] * s->a[e->column[i]];
    solved_transposed(s->factors + s->factors_first[k], s->pivots + first, s->nz[k], push);
    for (i = first; i < s->inner_first[k + 1]; ++i)
      s->lam[s->inner_row[i]] = s->factor[s->inner_row[i]] * push[i - first];
  }
}

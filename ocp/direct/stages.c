/* Between a partially separable program and fatrop's C interface: blocks in, matrices of stages out.

   The same text for every problem; sizes and places come in the tables that ocp/direct/native.py makes. What the solver
   sees is scaled: variables over `a`, rows and cost over their own. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "blasfeo.h"
#include "fatrop/ocp/OCPCInterface.h"

#define VAST 1e20
#define EXPORT __attribute__((visibility("default")))

enum { VALUE, GRADIENT, JACOBIAN, HESSIAN, KINDS };

/* Entries of the matrices of stages: number `source` times `scale` is added at (row, column) of `matrix`. */
typedef struct {
  int size;
  const int *matrix, *row, *column, *source;
  const double *scale;
} entries;

typedef struct {
  int stages, variables, rows, bounds, linear, values, slopes, duals;
  const int *nx, *nu, *ng, *ni; /* of each stage */
  const int *place; /* of each variable in fatrop's vector */
  const double *a;
  const int *target;           /* of each row in fatrop's vector of constraints; -1: not there */
  const double *factor, *shift; /* sign over scale; what an equality is asked to be */
  const int *bound_of, *bound_at; /* bounded variables: which, and where as a row */
  const double *bound_shift;
  const int *linear_row, *linear_column;
  const double *linear_value;
  double *numbers[KINDS]; /* of all blocks: costs and rows; slopes; entries of the Jacobian, of the Hessian */
  const int *value_row; /* of each number of VALUE; -1: a cost */
  const int *slope_at;  /* of each number of GRADIENT in fatrop's vector */
  const double *slope_scale;
  entries jacobian, hessian; /* matrix: of the Jacobian 3 k + 0 dynamics, 1 equalities, 2 inequalities of stage k */
  double cost_scale;
  double *x, *g, *lam; /* scratch: variables and rows as they are, multipliers of these */
  double sigma;
  const double *lower, *upper, *guess; /* in fatrop's order */
  int (*evaluate)(int); /* fills the numbers of a kind, at x, lam and sigma */
  int (*watch)(void);   /* not zero where the solve must end */
  struct FatropOcpCSolver *solver;
  int stopped, known;
  const int *slack_first, *primal_first;
  double *seen;
} program;

static double tame(double v) { return isnan(v) ? VAST : v > VAST ? VAST : v < -VAST ? -VAST : v; }

/* The variables of the program at fatrop's, and the values of the blocks there; not twice at the same place. */
static void move(program *s, const double *primal) {
  int i;
  if (s->known && !memcmp(s->seen, primal, sizeof(double) * (size_t)s->primal_first[s->stages])) return;
  memcpy(s->seen, primal, sizeof(double) * (size_t)s->primal_first[s->stages]);
  for (i = 0; i < s->variables; ++i) s->x[i] = primal[s->place[i]] * s->a[i];
  s->known = 1;
  s->evaluate(VALUE);
}

static int objective(double scale, const double *primal, const double *u0, const double *u1, double *out,
                     const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  double sum = 0;
  int i;
  move(s, primal);
  for (i = 0; i < s->values; ++i)
    if (s->value_row[i] < 0) sum += s->numbers[VALUE][i];
  *out = tame(scale * sum / s->cost_scale);
  return 1;
}

static int slope(double scale, const double *primal, const double *u0, const double *u1, double *out,
                 const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  int i;
  move(s, primal);
  s->evaluate(GRADIENT);
  memset(out, 0, sizeof(double) * (size_t)s->primal_first[s->stages]);
  for (i = 0; i < s->slopes; ++i) out[s->slope_at[i]] += scale * s->slope_scale[i] * tame(s->numbers[GRADIENT][i]);
  return 1;
}

static void sum_rows(program *s) {
  int i;
  memset(s->g, 0, sizeof(double) * (size_t)s->rows);
  for (i = 0; i < s->values; ++i)
    if (s->value_row[i] >= 0) s->g[s->value_row[i]] += s->numbers[VALUE][i];
  for (i = 0; i < s->linear; ++i) s->g[s->linear_row[i]] += s->linear_value[i] * s->x[s->linear_column[i]];
}

static int violation(const double *primal, const double *u0, const double *u1, double *out,
                     const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  int i;
  move(s, primal);
  sum_rows(s);
  for (i = 0; i < s->rows; ++i)
    if (s->target[i] >= 0) out[s->target[i]] = tame(s->factor[i] * s->g[i] - s->shift[i]);
  for (i = 0; i < s->bounds; ++i)
    out[s->bound_at[i]] = s->x[s->bound_of[i]] / s->a[s->bound_of[i]] - s->bound_shift[i];
  return 1;
}

static void add(const entries *e, const double *numbers, struct blasfeo_dmat **of) {
  int i;
  for (i = 0; i < e->size; ++i)
    BLASFEO_DMATEL(of[e->matrix[i]], e->row[i], e->column[i]) += e->scale[i] * tame(numbers[e->source[i]]);
}

static void clear(struct blasfeo_dmat *of, int rows, int columns) { blasfeo_dgese(rows, columns, 0.0, of, 0, 0); }

static int slopes_of_rows(const double *primal, const double *u0, const double *u1, struct blasfeo_dmat *dynamics,
                          struct blasfeo_dmat *equal, struct blasfeo_dmat *unequal, const struct FatropOcpCDims *d,
                          void *data) {
  program *s = data;
  struct blasfeo_dmat **of = malloc(sizeof(*of) * 3 * (size_t)s->stages);
  int k;
  if (!s->stopped && s->watch()) {
    s->stopped = 1;
    fatrop_ocp_c_set_option_int(s->solver, "max_iter", 0);
  }
  move(s, primal);
  s->evaluate(JACOBIAN);
  for (k = 0; k < s->stages; ++k) {
    of[3 * k] = dynamics + k;
    of[3 * k + 1] = equal + k;
    of[3 * k + 2] = unequal + k;
    if (k + 1 < s->stages) clear(dynamics + k, s->nu[k] + s->nx[k], s->nx[k + 1]);
    clear(equal + k, s->nu[k] + s->nx[k], s->ng[k]);
    clear(unequal + k, s->nu[k] + s->nx[k], s->ni[k]);
  }
  add(&s->jacobian, s->numbers[JACOBIAN], of);
  free(of);
  return 1;
}

static int curvature(double scale, const double *primal, const double *dual, const double *u0, const double *u1,
                     struct blasfeo_dmat *out, const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  struct blasfeo_dmat **of = malloc(sizeof(*of) * (size_t)s->stages);
  int i, k;
  move(s, primal);
  s->sigma = scale / s->cost_scale;
  for (i = 0; i < s->rows; ++i) s->lam[i] = s->target[i] < 0 ? 0.0 : s->factor[i] * dual[s->target[i]];
  s->evaluate(HESSIAN);
  for (k = 0; k < s->stages; ++k) {
    of[k] = out + k;
    clear(out + k, s->nu[k] + s->nx[k], s->nu[k] + s->nx[k]);
  }
  add(&s->hessian, s->numbers[HESSIAN], of);
  free(of);
  return 1;
}

static int count_x(int k, void *data) { return ((program *)data)->nx[k]; }
static int count_u(int k, void *data) { return ((program *)data)->nu[k]; }
static int count_g(int k, void *data) { return ((program *)data)->ng[k]; }
static int count_i(int k, void *data) { return ((program *)data)->ni[k]; }
static int horizon(void *data) { return ((program *)data)->stages; }
static int none_of(int k, void *data) { return 0; }
static int none(void *data) { return 0; }
static int nothing_of(double *p, int k, void *data) { return 0; }
static int nothing(double *p, void *data) { return 0; }

static int limits(double *lower, double *upper, int k, void *data) {
  program *s = data;
  memcpy(lower, s->lower + s->slack_first[k], sizeof(double) * (size_t)s->ni[k]);
  memcpy(upper, s->upper + s->slack_first[k], sizeof(double) * (size_t)s->ni[k]);
  return 0;
}
static int first_u(double *u, int k, void *data) {
  program *s = data;
  memcpy(u, s->guess + s->primal_first[k], sizeof(double) * (size_t)s->nu[k]);
  return 0;
}
static int first_x(double *x, int k, void *data) {
  program *s = data;
  memcpy(x, s->guess + s->primal_first[k] + s->nu[k], sizeof(double) * (size_t)s->nx[k]);
  return 0;
}

static void silent(const char *words, int size) {}
static void flush(void) {}

/* What is kept of one solver: its face must outlive it. */
typedef struct {
  struct FatropOcpCInterface face;
  struct FatropOcpCSolver *solver;
} kept;

EXPORT void *stages_create(program *s) {
  kept *k = calloc(1, sizeof *k);
  struct FatropOcpCInterface *f = &k->face;
  f->get_nx = count_x, f->get_nu = count_u, f->get_ng = count_g, f->get_ng_ineq = count_i;
  f->get_n_stage_params = none_of, f->get_n_global_params = none;
  f->get_default_stage_params = nothing_of, f->get_default_global_params = nothing;
  f->get_horizon_length = horizon;
  f->get_bounds = limits, f->get_initial_xk = first_x, f->get_initial_uk = first_u;
  f->full_eval_lag_hess = curvature, f->full_eval_constr_jac = slopes_of_rows;
  f->full_eval_contr_viol = violation, f->full_eval_obj_grad = slope, f->full_eval_obj = objective;
  f->user_data = s;
  k->solver = fatrop_ocp_c_create(f, silent, flush);
  return k;
}

/* Where the rows of each stage stand in fatrop's vector of constraints: dynamics, equalities, inequalities. */
EXPORT void stages_places(void *handle, int *places, int stages) {
  const struct FatropOcpCDims *d = fatrop_ocp_c_get_dims(((kept *)handle)->solver);
  int k;
  for (k = 0; k < stages; ++k) {
    places[3 * k] = k + 1 < stages ? d->dyn_eq_offs[k] : -1;
    places[3 * k + 1] = d->g_offs[k];
    places[3 * k + 2] = d->g_ineq_offs[k];
  }
}

EXPORT void stages_option(void *handle, const char *name, int type, double value) {
  struct FatropOcpCSolver *solver = ((kept *)handle)->solver;
  if (type == 0) fatrop_ocp_c_set_option_double(solver, name, value);
  if (type == 1) fatrop_ocp_c_set_option_int(solver, name, (int)value);
  if (type == 2) fatrop_ocp_c_set_option_bool(solver, name, value != 0);
}

/* Solve; `told`: flag, iterations. */
EXPORT int stages_solve(void *handle, program *s, double *primal, double *dual, int *told) {
  kept *k = handle;
  int word;
  s->solver = k->solver;
  s->known = s->stopped = 0;
  word = fatrop_ocp_c_solve(k->solver);
  memcpy(primal, fatrop_ocp_c_get_primal(k->solver)->pa, sizeof(double) * (size_t)s->primal_first[s->stages]);
  memcpy(dual, fatrop_ocp_c_get_dual(k->solver)->pa, sizeof(double) * (size_t)s->duals);
  told[0] = word < 0 ? -1 : fatrop_ocp_c_get_stats(k->solver)->return_flag;
  told[1] = fatrop_ocp_c_get_stats(k->solver)->iterations_count;
  return 0;
}

/* Cost (scaled) and rows (as they are, in `g`) at some variables. */
EXPORT void stages_values(program *s, const double *primal, double *cost) {
  move(s, primal);
  objective(1.0, primal, 0, 0, cost, 0, s);
  sum_rows(s);
}

EXPORT int stages_option_type(const char *name) { return fatrop_ocp_c_option_type(name); }

EXPORT void stages_destroy(void *handle) {
  fatrop_ocp_c_destroy(((kept *)handle)->solver);
  free(handle);
}

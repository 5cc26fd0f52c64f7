/* What fatrop asks of a program, and its face to Python. */

static int objective(double scale, const double *primal, const double *u0, const double *u1, double *out,
                     const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  double sum = 0;
  int i;
  *out = VAST;
  if (!move(s, primal)) return 1;
  for (i = 0; i < s->values; ++i)
    if (s->value_row[i] < 0) sum += s->numbers[VALUE][i];
  *out = tame(scale * sum / s->cost_scale);
  return 1;
}

static int slope(double scale, const double *primal, const double *u0, const double *u1, double *out,
                 const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  int i, j, k, q;
  memset(out, 0, sizeof(double) * (size_t)s->primal_first[s->stages]);
  if (!slopes_at(s, primal)) {
    give_up(s);
    return 1;
  }
  slope_of_cost(s);
  for (i = 0; i < s->variables; ++i)
    if (s->place[i] >= 0) out[s->place[i]] = scale * s->slope[i];
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k);
    const double *along = s->sensitivity + s->sensitivity_first[k];
    double *mine = out + s->primal_first[k];
    for (j = 0, i = s->inner_first[k]; i < s->inner_first[k + 1]; ++i, ++j) {
      const double v = scale * s->slope[s->inner_variable[i]];
      if (v != 0.0)
        for (q = 0; q < w; ++q) mine[q] += v * along[j * w + q];
    }
  }
  return 1;
}

static int violation(const double *primal, const double *u0, const double *u1, double *out,
                     const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  const int found = move(s, primal);
  int i;
  for (i = 0; i < s->rows; ++i)
    if (s->target[i] >= 0) out[s->target[i]] = found ? tame(s->factor[i] * s->g[i] - s->shift[i]) : VAST;
  return 1;
}

static void clear(struct blasfeo_dmat *of, int rows, int columns) { blasfeo_dgese(rows, columns, 0.0, of, 0, 0); }

/* Powers of ten by which what the first stage does grows along the horizon, without the controls. */
static double growth(const program *s, struct blasfeo_dmat *dynamics) {
  double *x = s->scratch, *next = x + s->most, powers = 0.0;
  int i, j, k;
  for (i = 0; i < s->nx[0]; ++i) x[i] = 1.0 + 0.1 * (i % 7);
  for (k = 0; k + 1 < s->stages; ++k) {
    double size = 0.0;
    for (j = 0; j < s->nx[k + 1]; ++j) {
      next[j] = 0.0;
      for (i = 0; i < s->nx[k]; ++i) next[j] += BLASFEO_DMATEL(dynamics + k, s->nu[k] + i, j) * x[i];
      size = fmax(size, fabs(next[j]));
    }
    if (size == 0.0) return powers;
    powers += log10(size);
    for (j = 0; j < s->nx[k + 1]; ++j) x[j] = next[j] / size;
  }
  return powers;
}

static int slopes_of_rows(const double *primal, const double *u0, const double *u1, struct blasfeo_dmat *dynamics,
                          struct blasfeo_dmat *equal, struct blasfeo_dmat *unequal, const struct FatropOcpCDims *d,
                          void *data) {
  program *s = data;
  const entries *e = &s->jacobian;
  int i, k, q;
  must_end(s);
  if (!slopes_at(s, primal)) give_up(s);
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k);
    struct blasfeo_dmat *of[3] = {dynamics + k, equal + k, unequal + k};
    if (k + 1 < s->stages) clear(dynamics + k, w, s->nx[k + 1]);
    clear(equal + k, w, s->ng[k]);
    clear(unequal + k, w, s->ni[k]);
    for (i = e->first[k]; i < e->first[k + 1] && !s->lost; ++i) {
      const double v = s->numbers[JACOBIAN][e->source[i]] * s->factor[e->row[i]] * s->a[e->column[i]];
      struct blasfeo_dmat *m = of[s->kind[e->row[i]]];
      const int at = s->position[e->row[i]], c = s->local[e->column[i]];
      if (wild(v)) give_up(s);
      if (c < w) {
        BLASFEO_DMATEL(m, c, at) += v;
      } else {
        const double *along = s->sensitivity + s->sensitivity_first[k] + (c - w) * w;
        for (q = 0; q < w; ++q) {
          if (wild(v * along[q])) give_up(s);
          BLASFEO_DMATEL(m, q, at) += v * along[q];
        }
      }
    }
  }
  if (!s->lost && growth(s, dynamics) > GROWTH) give_up(s);
  for (k = 0; k < s->stages && s->lost; ++k) { /* what lets its step end */
    if (k + 1 < s->stages) clear(dynamics + k, own(s, k), s->nx[k + 1]);
    clear(equal + k, own(s, k), s->ng[k]);
    clear(unequal + k, own(s, k), s->ni[k]);
    for (i = 0; i < s->ng[k]; ++i) BLASFEO_DMATEL(equal + k, i, i) = 1.0;
  }
  return 1;
}

/* Half the curvature of stage k along (1, E), (w, w): it and its mirror image make the whole. */
static const double *half_curvature(const program *s, int k) {
  const entries *e = &s->hessian;
  const int w = own(s, k), n = s->nz[k];
  const double *along = s->sensitivity + s->sensitivity_first[k];
  double *half = s->scratch; /* (w + n, w): along (1, E) on its right side; then, above, on both */
  int i, j, q, r;
  memset(half, 0, sizeof(double) * (size_t)((w + n) * w));
  for (i = e->first[k]; i < e->first[k + 1]; ++i) {
    const int c = s->local[e->column[i]];
    const double scales = s->half[i] * s->a[e->row[i]] * s->a[e->column[i]];
    const double v = tame(s->numbers[HESSIAN][e->source[i]]) * scales;
    double *mine = half + s->local[e->row[i]] * w;
    if (c < w) mine[c] += v;
    else
      for (q = 0; q < w; ++q) mine[q] += v * along[(c - w) * w + q];
  }
  for (j = 0; j < n; ++j) {
    const double *mine = half + (w + j) * w;
    for (r = 0; r < w; ++r) {
      const double v = along[j * w + r];
      if (v != 0.0)
        for (q = 0; q < w; ++q) half[r * w + q] += v * mine[q];
    }
  }
  return half;
}

static int curvature(double scale, const double *primal, const double *dual, const double *u0, const double *u1,
                     struct blasfeo_dmat *out, const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  int k, q, r;
  if (!s->lost && !slopes_at(s, primal)) give_up(s);
  if (!s->lost) {
    s->sigma = scale / s->cost_scale;
    multipliers(s, scale, dual);
    s->evaluate(HESSIAN);
  }
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k);
    const double *half = s->lost ? 0 : half_curvature(s, k);
    clear(out + k, w, w);
    for (r = 0; r < w && !s->lost; ++r)
      for (q = 0; q < w; ++q) {
        const double v = half[r * w + q] + half[q * w + r];
        if (wild(v)) give_up(s);
        BLASFEO_DMATEL(out + k, r, q) = v;
      }
  }
  for (k = 0; k < s->stages && s->lost; ++k) {
    clear(out + k, own(s, k), own(s, k));
    for (r = 0; r < own(s, k); ++r) BLASFEO_DMATEL(out + k, r, r) = 1.0;
  }
  return 1;
}

/* ---- does the cost curve upwards along what no limit holds ---- */

#define PUSHES 1e-8 /* the multiplier from which on a limit pushes */

/* Whether a row is given, or stands at a limit that pushes more than it is away. */
static int held(const program *s, int row, int k, const double *dual) {
  const int at = s->slack_first[k] + s->position[row];
  const double value = s->factor[row] * s->g[row], push = dual[s->target[row]];
  if (s->kind[row] != 2) return 1;
  return (push < -PUSHES && value - s->lower[at] < -push) || (push > PUSHES && s->upper[at] - value < push);
}

/* m (w, w) becomes its lower factor of Cholesky; 0 where it is not positive definite. */
static int rooted(double *m, int w) {
  int c, q, r;
  for (c = 0; c < w; ++c) {
    double *mine = m + c * w;
    for (r = 0; r <= c; ++r) {
      double sum = mine[r];
      for (q = 0; q < r; ++q) sum -= mine[q] * m[r * w + q];
      if (r < c) mine[r] = sum / m[r * w + r];
      else if (sum > 0.0) mine[c] = sqrt(sum);
      else return 0;
    }
  }
  return 1;
}

/* Whether the curvature over `largest` is positive definite once what misses the held rows costs `price` (Finsler):
   the stages one after the other, each with what those before it leave to its states. */
static int convex(program *s, const double *dual, double price, double largest, int most_rows, double *scratch) {
  const entries *e = &s->jacobian;
  const int most = s->most;
  double *m = scratch, *rows = m + most * most, *left = rows + most_rows * most, *root = left + most * most;
  int i, j, k, q, r;
  memset(left, 0, sizeof(double) * (size_t)(most * most));
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k), u = s->nu[k], x = s->nx[k], next = k + 1 < s->stages ? s->nx[k + 1] : 0;
    const int before[3] = {0, next, next + s->ng[k]}, all = next + s->ng[k] + s->ni[k];
    const double *half = half_curvature(s, k);
    for (r = 0; r < w; ++r)
      for (q = 0; q < w; ++q) m[r * w + q] = (half[r * w + q] + half[q * w + r]) / largest;
    for (r = 0; r < x; ++r)
      for (q = 0; q < x; ++q) m[(u + r) * w + u + q] += left[r * x + q];
    memset(rows, 0, sizeof(double) * (size_t)(all * w));
    for (i = e->first[k]; i < e->first[k + 1]; ++i) {
      const int row = e->row[i], c = s->local[e->column[i]];
      const double v = s->numbers[JACOBIAN][e->source[i]] * s->factor[row] * s->a[e->column[i]];
      double *mine = rows + (before[s->kind[row]] + s->position[row]) * w;
      if (!held(s, row, k, dual)) continue;
      if (c < w) mine[c] += v;
      else
        for (q = 0; q < w; ++q) mine[q] += v * s->sensitivity[s->sensitivity_first[k] + (c - w) * w + q];
    }
    memset(left, 0, sizeof(double) * (size_t)(most * most));
    for (j = 0; j < all; ++j) {
      double *mine = rows + j * w, size = j < next ? 1.0 : 0.0;
      for (q = 0; q < w; ++q) size += mine[q] * mine[q];
      if (size == 0.0) continue;
      for (r = 0; r < w; ++r)
        for (q = 0; q <= r; ++q) m[r * w + q] += price / size * mine[r] * mine[q];
      if (j < next) {
        left[j * next + j] = price / size;
        for (q = 0; q < w; ++q) mine[q] *= -price / size;
      }
    }
    if (!rooted(m, w)) return 0;
    for (j = 0; j < next; ++j) { /* what the stage leaves: less the square of the factors times its coupling */
      double *mine = root + j * w;
      for (r = 0; r < w; ++r) {
        double sum = rows[j * w + r];
        for (q = 0; q < r; ++q) sum -= m[r * w + q] * mine[q];
        mine[r] = sum / m[r * w + r];
      }
      for (i = 0; i <= j; ++i) {
        double sum = 0.0;
        for (q = 0; q < w; ++q) sum += mine[q] * root[i * w + q];
        left[j * next + i] -= sum;
        if (i < j) left[i * next + j] -= sum;
      }
    }
  }
  return 1;
}

/* Whether the cost curves upwards along all that the limits leave free; no, too, where only a price beyond what
   rounding allows says so. */
EXPORT int stages_curve_upwards(program *s, const double *primal, const double *dual) {
  double largest = 0.0, *scratch;
  int i, k, most_rows = 0, found;
  if (!slopes_at(s, primal)) return 0;
  s->sigma = 1.0 / s->cost_scale;
  multipliers(s, 1.0, dual);
  s->evaluate(HESSIAN);
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k), rows = s->ng[k] + s->ni[k] + (k + 1 < s->stages ? s->nx[k + 1] : 0);
    const double *half = half_curvature(s, k);
    for (i = 0; i < w * w; ++i) largest = fmax(largest, fabs(half[i]));
    if (rows > most_rows) most_rows = rows;
  }
  if (!(largest < VAST)) return 0;
  if (largest == 0.0) largest = 1.0;
  scratch = malloc(sizeof(double) * (size_t)(s->most * (3 * s->most + most_rows)));
  found = scratch && (convex(s, dual, 1e3, largest, most_rows, scratch) || convex(s, dual, 1e6, largest, most_rows, scratch));
  free(scratch);
  return found;
}

/* ---- its face ---- */

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

/* Solve; `told`: flag, or -1 where it cannot go on; iterations. */
EXPORT int stages_solve(void *handle, program *s, double *primal, double *dual, int *told) {
  kept *k = handle;
  int i, word = -1;
  s->solver = k->solver;
  s->known = s->factored = s->stopped = s->lost = 0;
  for (i = 0; i < s->inner_first[s->stages]; ++i)
    s->before[s->primal_first[s->stages] + i] = s->x[s->inner_variable[i]] / s->a[s->inner_variable[i]];
  memcpy(primal, s->guess, sizeof(double) * (size_t)s->primal_first[s->stages]);
  memset(dual, 0, sizeof(double) * (size_t)s->duals);
  told[1] = 0;
  if (move(s, primal)) {
    word = fatrop_ocp_c_solve(k->solver);
    memcpy(primal, fatrop_ocp_c_get_primal(k->solver)->pa, sizeof(double) * (size_t)s->primal_first[s->stages]);
    memcpy(dual, fatrop_ocp_c_get_dual(k->solver)->pa, sizeof(double) * (size_t)s->duals);
    told[1] = fatrop_ocp_c_get_stats(k->solver)->iterations_count;
  }
  told[0] = word < 0 || s->lost ? -1 : fatrop_ocp_c_get_stats(k->solver)->return_flag;
  return 0;
}

/* Cost (scaled); rows and their multipliers (as they are, in `g` and `lam`) at some variables. */
EXPORT void stages_values(program *s, const double *primal, const double *dual, double *cost) {
  objective(1.0, primal, 0, 0, cost, 0, s);
  memset(s->lam, 0, sizeof(double) * (size_t)s->rows);
  if (slopes_at(s, primal)) multipliers(s, 1.0, dual);
}

EXPORT int stages_option_type(const char *name) { return fatrop_ocp_c_option_type(name); }

EXPORT void stages_destroy(void *handle) {
  fatrop_ocp_c_destroy(((kept *)handle)->solver);
  free(handle);
}

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
    s->lost = 1, end(s);
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

static int slopes_of_rows(const double *primal, const double *u0, const double *u1, struct blasfeo_dmat *dynamics,
                          struct blasfeo_dmat *equal, struct blasfeo_dmat *unequal, const struct FatropOcpCDims *d,
                          void *data) {
  program *s = data;
  const entries *e = &s->jacobian;
  int i, k, q;
  must_end(s);
  if (!slopes_at(s, primal)) s->lost = 1, end(s);
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k);
    struct blasfeo_dmat *of[3] = {dynamics + k, equal + k, unequal + k};
    if (k + 1 < s->stages) clear(dynamics + k, w, s->nx[k + 1]);
    clear(equal + k, w, s->ng[k]);
    clear(unequal + k, w, s->ni[k]);
    if (s->lost) continue;
    for (i = e->first[k]; i < e->first[k + 1]; ++i) {
      const double v = tame(s->numbers[JACOBIAN][e->source[i]]) * s->factor[e->row[i]] * s->a[e->column[i]];
      struct blasfeo_dmat *m = of[s->kind[e->row[i]]];
      const int at = s->position[e->row[i]], c = s->local[e->column[i]];
      if (c < w) {
        BLASFEO_DMATEL(m, c, at) += v;
      } else {
        const double *along = s->sensitivity + s->sensitivity_first[k] + (c - w) * w;
        for (q = 0; q < w; ++q) BLASFEO_DMATEL(m, q, at) += v * along[q];
      }
    }
  }
  return 1;
}

static int curvature(double scale, const double *primal, const double *dual, const double *u0, const double *u1,
                     struct blasfeo_dmat *out, const struct FatropOcpCDims *d, void *data) {
  program *s = data;
  const entries *e = &s->hessian;
  int i, j, k, q, r;
  for (k = 0; k < s->stages; ++k) clear(out + k, own(s, k), own(s, k));
  if (!slopes_at(s, primal)) s->lost = 1, end(s);
  if (s->lost) return 1;
  s->sigma = scale / s->cost_scale;
  multipliers(s, scale, dual);
  s->evaluate(HESSIAN);
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k), n = s->nz[k];
    const double *along = s->sensitivity + s->sensitivity_first[k];
    double *half = s->scratch; /* half the curvature along (1, E) on its right side; then on both */
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
    for (r = 0; r < w; ++r)
      for (q = 0; q < w; ++q) BLASFEO_DMATEL(out + k, r, q) = half[r * w + q] + half[q * w + r];
  }
  return 1;
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

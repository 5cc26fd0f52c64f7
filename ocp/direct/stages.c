/* What the solver asks of a program at a point, and whether the cost curves upwards where it ends. */

static int objective(program *s, const double *primal, double *cost) {
  double sum = 0.0;
  int i;
  if (!move(s, primal)) return 0;
  for (i = 0; i < s->values; ++i)
    if (s->value_row[i] < 0) sum += s->numbers[VALUE][i];
  *cost = sum / s->cost_scale;
  return fabs(*cost) < VAST;
}

/* The rows; of inequalities as they are, of the others what they miss. */
static int rows_of(program *s, const double *primal, double *out) {
  int i;
  if (!move(s, primal)) return 0;
  for (i = 0; i < s->rows; ++i) {
    if (s->target[i] < 0) continue;
    out[s->target[i]] = s->factor[i] * s->g[i] - s->shift[i];
    if (!(fabs(out[s->target[i]]) < VAST)) return 0;
  }
  return 1;
}

/* The slope of the cost along what inner variables do. */
static int slope(program *s, const double *primal, double *out) {
  int i, j, k, q;
  memset(out, 0, sizeof(double) * (size_t)s->primal_first[s->stages]);
  if (!slopes_at(s, primal)) return 0;
  slope_of_cost(s);
  for (i = 0; i < s->variables; ++i)
    if (s->place[i] >= 0) out[s->place[i]] = s->slope[i];
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k);
    const double *along = s->sensitivity + s->sensitivity_first[k];
    double *mine = out + s->primal_first[k];
    for (j = 0, i = s->inner_first[k]; i < s->inner_first[k + 1]; ++i, ++j)
      if (s->slope[s->inner_variable[i]] != 0.0) add(mine, s->slope[s->inner_variable[i]], along + j * w, w);
    for (q = 0; q < w; ++q)
      if (wild(mine[q])) return 0;
  }
  return 1;
}

/* The slopes of the rows of all stages. */
static int slopes_of_rows(program *s, const double *primal, stage *stages) {
  const entries *e = &s->jacobian;
  int i, k;
  if (!slopes_at(s, primal)) return 0;
  for (k = 0; k < s->stages; ++k) {
    stage *a = stages + k;
    const int w = a->w, all = a->next + a->g + a->i, before[3] = {0, a->next, a->next + a->g};
    memset(a->slopes, 0, sizeof(double) * (size_t)(all * w));
    for (i = e->first[k]; i < e->first[k + 1]; ++i) {
      const double v = s->numbers[JACOBIAN][e->source[i]] * s->factor[e->row[i]] * s->a[e->column[i]];
      const int c = s->local[e->column[i]];
      double *row = a->slopes + (before[s->kind[e->row[i]]] + s->position[e->row[i]]) * w;
      if (c < w) row[c] += v;
      else add(row, v, s->sensitivity + s->sensitivity_first[k] + (c - w) * w, w);
    }
    for (i = 0; i < all * w; ++i)
      if (wild(a->slopes[i])) return 0;
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

/* The curvature of the Lagrangian, of the cost times `scale`, in all stages. */
static int curvature(program *s, double scale, const double *primal, const double *dual, stage *stages) {
  int k, q, r;
  if (!slopes_at(s, primal)) return 0;
  s->sigma = scale / s->cost_scale;
  multipliers(s, scale, dual);
  s->evaluate(HESSIAN);
  for (k = 0; k < s->stages; ++k) {
    const int w = own(s, k);
    const double *half = half_curvature(s, k);
    for (r = 0; r < w; ++r)
      for (q = 0; q < w; ++q) {
        const double v = stages[k].curvature[r * w + q] = half[r * w + q] + half[q * w + r];
        if (wild(v)) return 0;
      }
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
  found = scratch && (convex(s, dual, 1e3, largest, most_rows, scratch) ||
                      convex(s, dual, 1e6, largest, most_rows, scratch));
  free(scratch);
  return found;
}


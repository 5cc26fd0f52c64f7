/* Newton's step over the stages: a quadratic program with equalities, solved from the last stage to the first.

   Stage k has variables w = (u, x): what is decided there, and its states. Of all steps with x+ = A w + b from stage to
   stage and G w + e = 0, the one of least sum of q w + w H w / 2. What later stages cost is p x + x P x / 2, and what
   they ask is C x + c = 0; so stage k asks (G; C A) w + ... = 0. As many of these rows as can decide some of u,
   Gaussian elimination takes with full pivoting; the others are left to x. What is still free of u costs least by the
   factors of Cholesky, which are there if and only if the curvature is positive definite along all that the rows leave
   free: that is how the inertia is known. Of the first stage all variables are decided, and none is a state.

   What is left of a row that others imply, `dependent` relative to what it was made of or less, counts as nothing: what
   follows from so little would be all rounding. Refinement makes good for it. */

#define FLAT 1e-14 /* what is left of a curvature that is none, relative to what it was made of */

typedef struct {
  int w, u, x, next, g, i;      /* variables, those decided, states; of the next stage; equalities, inequalities */
  int at, dynamics, equal, unequal; /* where its variables begin, and its rows of each kind */
  int asked, rank, left;        /* rows asked of w; of them those that decide, and those that are left to x */
  int *row, *column;            /* what the row and the column of each pivot were swapped with */
  double *curvature, *slopes;   /* H (w, w); (next + g + i, w): A, G, of inequalities */
  double *whole, *rows, *lower; /* H with later costs (w, w), in the order of pivots; asked rows and their factors */
  double *gain, *cost;          /* (u, w), what the rows decide; P (x, x) */
  double *m, *d, *t;            /* of one right side: (w), (asked), (u) */
} stage;

static void swapped(double *a, double *b, int n, int apart) {
  int i;
  for (i = 0; i < n; ++i) {
    const double kept = a[i * apart];
    a[i * apart] = b[i * apart], b[i * apart] = kept;
  }
}

static void add(double *to, double times, const double *of, int n) {
  int i;
  for (i = 0; i < n; ++i) to[i] += times * of[i];
}

static double dot(const double *a, const double *b, int n) {
  double sum = 0.0;
  int i;
  for (i = 0; i < n; ++i) sum += a[i] * b[i];
  return sum;
}

/* The pivot of rows from `c` on and columns first .. last, taken off the rows below; 0 where none is left. */
static int pivoted(stage *a, double dependent, double *size, int c, int first, int last) {
  const int w = a->w, n = a->asked;
  double best = dependent, *rows = a->rows;
  int i, j, r = -1, column = -1;
  for (i = c; i < n; ++i)
    for (j = first; j < last; ++j)
      if (fabs(rows[i * w + j]) > best * size[i]) best = fabs(rows[i * w + j]) / size[i], r = i, column = j;
  if (r < 0) return 0;
  a->row[c] = r;
  swapped(rows + c * w, rows + r * w, w, 1);
  swapped(a->lower + c * n, a->lower + r * n, c, 1);
  swapped(size + c, size + r, 1, 1);
  if (last == a->u) {
    a->column[c] = column;
    swapped(rows + c, rows + column, n, w);
    swapped(a->whole + c, a->whole + column, w, w);
    swapped(a->whole + c * w, a->whole + column * w, w, 1);
    column = c;
  }
  for (i = c + 1; i < n; ++i) {
    const double f = rows[i * w + column] / rows[c * w + column];
    a->lower[i * n + c] = f;
    if (f != 0.0) add(rows + i * w + first, -f, rows + c * w + first, w - first);
    rows[i * w + column] = 0.0;
  }
  return 1;
}

/* Rows asked of a stage, and its curvature with what later stages, from `b` on, cost. */
static void gathered(stage *a, const stage *b, double shift, double *size, double *scratch) {
  const int w = a->w, next = a->next;
  const double *along = a->slopes;
  int i, j, r;
  memcpy(a->whole, a->curvature, sizeof(double) * (size_t)(w * w));
  for (i = 0; i < w; ++i) a->whole[i * w + i] += shift;
  memcpy(a->rows, a->slopes + next * w, sizeof(double) * (size_t)(a->g * w));
  a->asked = a->g + (next ? b->left : 0);
  memset(a->rows + a->g * w, 0, sizeof(double) * (size_t)((a->asked - a->g) * w));
  for (i = 0; i < a->asked; ++i) size[i] = 0.0;
  for (i = 0; i < next; ++i) {
    memset(scratch, 0, sizeof(double) * (size_t)w);
    for (j = 0; j < next; ++j)
      if (b->cost[i * next + j] != 0.0) add(scratch, b->cost[i * next + j], along + j * w, w);
    for (r = 0; r < w; ++r)
      if (along[i * w + r] != 0.0) add(a->whole + r * w, along[i * w + r], scratch, w);
  }
  for (j = a->g; j < a->asked; ++j) {
    const double *asked = b->rows + (b->rank + j - a->g) * b->w + b->u;
    for (i = 0; i < next; ++i) {
      if (asked[i] == 0.0) continue;
      add(a->rows + j * w, asked[i], along + i * w, w);
      for (r = 0; r < w; ++r) size[j] = fmax(size[j], fabs(asked[i] * along[i * w + r]));
    }
  }
  for (j = 0; j < a->g; ++j)
    for (r = 0; r < w; ++r) size[j] = fmax(size[j], fabs(a->rows[j * w + r]));
}

/* The factors of a stage before `b`; 0 where the cost does not curve upwards along what is free there. */
static int factorised_stage(stage *a, const stage *b, double shift, double dependent, double *scratch) {
  const int w = a->w, u = a->u, x = a->x;
  double *m = a->whole, *size = scratch, *made = scratch + a->g + a->next;
  int c, i, j, r;
  gathered(a, b, shift, size, made);
  for (c = 0; c < a->asked && c < u && pivoted(a, dependent, size, c, c, u); ++c) {}
  a->rank = c;
  for (i = c; i < a->asked; ++i) memset(a->rows + i * w, 0, sizeof(double) * (size_t)u);
  for (; c < a->asked && c - a->rank < x && pivoted(a, dependent, size, c, u, w); ++c) {}
  a->left = c - a->rank;

  for (c = a->rank - 1; c >= 0; --c) { /* what the rows decide follows the rest */
    const double *row = a->rows + c * w;
    double *gain = a->gain + c * w;
    for (j = a->rank; j < w; ++j) gain[j] = -row[j];
    for (i = c + 1; i < a->rank; ++i)
      if (row[i] != 0.0) add(gain + a->rank, -row[i], a->gain + i * w + a->rank, w - a->rank);
    for (j = a->rank; j < w; ++j) gain[j] /= row[c];
  }
  for (r = 0; r < w; ++r)
    for (c = 0; c < a->rank; ++c)
      if (m[r * w + c] != 0.0) add(m + r * w + a->rank, m[r * w + c], a->gain + c * w + a->rank, w - a->rank);
  for (c = 0; c < a->rank; ++c)
    for (r = a->rank; r < w; ++r)
      if (a->gain[c * w + r] != 0.0) add(m + r * w + r, a->gain[c * w + r], m + c * w + r, w - r);

  for (r = a->rank; r < u; ++r) made[r] = fabs(m[r * w + r]);
  for (c = a->rank; c < u; ++c) {
    double *row = m + c * w;
    if (!(row[c] > FLAT * made[c])) return 0;
    row[c] = sqrt(row[c]);
    for (j = c + 1; j < w; ++j) row[j] /= row[c];
    for (r = c + 1; r < w; ++r)
      if (row[r] != 0.0) add(m + r * w + r, -row[r], row + r, w - r);
  }
  for (i = 0; i < x; ++i)
    for (j = i; j < x; ++j) {
      const double v = m[(u + i) * w + u + j];
      if (!isfinite(v)) return 0;
      a->cost[i * x + j] = a->cost[j * x + i] = v;
    }
  return 1;
}

/* The factors of all stages with `shift` added to the curvature of each variable; 0 where it is not positive definite
   along what the rows leave free. */
static int factorised_stages(stage *stages, int count, double shift, double dependent, double *scratch) {
  int k;
  for (k = count - 1; k >= 0; --k)
    if (!factorised_stage(stages + k, stages + k + 1, shift, dependent, scratch)) return 0;
  return 1;
}

static void backwards(stage *a, const stage *b, const double *q, const double *missed) {
  const int w = a->w, u = a->u, rank = a->rank, n = a->asked, next = a->next;
  const double *rest = missed + a->dynamics;
  double *m = a->m, *d = a->d, *t = a->t;
  int c, i;
  memcpy(m, q + a->at, sizeof(double) * (size_t)w);
  memcpy(d, missed + a->equal, sizeof(double) * (size_t)a->g);
  for (i = 0; i < next; ++i)
    add(m, b->m[b->u + i] + dot(b->cost + i * next, rest, next), a->slopes + i * w, w);
  for (i = a->g; i < n; ++i) {
    const int r = b->rank + i - a->g;
    d[i] = b->d[r] + dot(b->rows + r * b->w + b->u, rest, next);
  }
  for (c = 0; c < rank + a->left; ++c) swapped(d + c, d + a->row[c], 1, 1);
  for (c = 0; c < rank + a->left; ++c)
    for (i = c + 1; i < n; ++i) d[i] -= a->lower[i * n + c] * d[c];
  for (c = 0; c < rank; ++c) swapped(m + c, m + a->column[c], 1, 1);
  for (c = rank - 1; c >= 0; --c)
    t[c] = -(d[c] + dot(a->rows + c * w + c + 1, t + c + 1, rank - c - 1)) / a->rows[c * w + c];
  for (i = 0; i < w; ++i) m[i] += dot(a->whole + i * w, t, rank);
  for (c = 0; c < rank; ++c) add(m + rank, m[c], a->gain + c * w + rank, w - rank);
  for (c = rank; c < u; ++c) {
    m[c] /= a->whole[c * w + c];
    add(m + c + 1, -m[c], a->whole + c * w + c + 1, w - c - 1);
  }
}

/* The step of a stage whose states are known, and the multipliers of its rows; `pushed` of those left to x. */
static void forwards(stage *a, const stage *b, const double *missed, double *step, double *dual, double *pushed,
                     double *scratch) {
  const int w = a->w, u = a->u, rank = a->rank, n = a->asked, next = a->next;
  double *own = step + a->at;
  int c, i;
  for (c = u - 1; c >= rank; --c)
    own[c] = -(a->m[c] + dot(a->whole + c * w + c + 1, own + c + 1, w - c - 1)) / a->whole[c * w + c];
  for (c = 0; c < rank; ++c) own[c] = a->t[c] + dot(a->gain + c * w + rank, own + rank, w - rank);
  for (c = 0; c < rank; ++c) scratch[c] = -(a->m[c] + dot(a->whole + c * w + rank, own + rank, w - rank));
  for (c = 0; c < rank; ++c) {
    scratch[c] /= a->rows[c * w + c];
    add(scratch + c + 1, -scratch[c], a->rows + c * w + c + 1, rank - c - 1);
  }
  memcpy(scratch + rank, pushed, sizeof(double) * (size_t)a->left);
  for (c = rank + a->left; c < n; ++c) scratch[c] = 0.0;
  for (c = rank + a->left - 1; c >= 0; --c)
    for (i = c + 1; i < n; ++i) scratch[c] -= a->lower[i * n + c] * scratch[i];
  for (c = rank + a->left - 1; c >= 0; --c) swapped(scratch + c, scratch + a->row[c], 1, 1);
  memcpy(dual + a->equal, scratch, sizeof(double) * (size_t)a->g);
  memcpy(pushed, scratch + a->g, sizeof(double) * (size_t)(n - a->g));
  for (c = rank - 1; c >= 0; --c) swapped(own + c, own + a->column[c], 1, 1);
  for (i = 0; i < next; ++i)
    step[b->at + b->u + i] = missed[a->dynamics + i] + dot(a->slopes + i * w, own, w);
  for (i = 0; i < next; ++i)
    dual[a->dynamics + i] = b->m[b->u + i] + dot(b->cost + i * next, step + b->at + b->u, next);
  for (c = 0; c < n - a->g; ++c)
    add(dual + a->dynamics, pushed[c], b->rows + (b->rank + c) * b->w + b->u, next);
}

/* The step for slopes `q` of the cost and what the rows miss, and the multipliers of the equalities. */
static void solved_stages(stage *stages, int count, const double *q, const double *missed, double *step, double *dual,
                          double *scratch) {
  int k, most = 0;
  for (k = 0; k < count; ++k) most = stages[k].asked > most ? stages[k].asked : most;
  for (k = count - 1; k >= 0; --k) backwards(stages + k, stages + k + 1, q, missed);
  for (k = 0; k < count; ++k) forwards(stages + k, stages + k + 1, missed, step, dual, scratch, scratch + most);
}

/* What a step and multipliers leave of the conditions of the least: `of_cost`, `of_rows`. The largest of it. */
static double left_of(const stage *stages, int count, double shift, const double *q, const double *missed,
                      const double *step, const double *dual, double *of_cost, double *of_rows) {
  double largest = 0.0;
  int i, k, r;
  for (k = 0; k < count; ++k) {
    const stage *a = stages + k, *b = a + 1;
    const int w = a->w, all = a->next + a->g;
    const double *own = step + a->at;
    for (r = 0; r < w; ++r)
      of_cost[a->at + r] = q[a->at + r] + shift * own[r] + dot(a->curvature + r * w, own, w);
    if (k)
      for (i = 0; i < a->x; ++i) of_cost[a->at + a->u + i] -= dual[(a - 1)->dynamics + i];
    for (i = 0; i < all; ++i) {
      const int at = i < a->next ? a->dynamics + i : a->equal + i - a->next;
      add(of_cost + a->at, dual[at], a->slopes + i * w, w);
      of_rows[at] = missed[at] + dot(a->slopes + i * w, own, w) - (i < a->next ? step[b->at + b->u + i] : 0.0);
      largest = fmax(largest, fabs(of_rows[at]));
    }
    for (r = 0; r < w; ++r) largest = fmax(largest, fabs(of_cost[a->at + r]));
  }
  return largest;
}

/* An interior-point method over the stages, and the face of all to Python.

   Waechter, Biegler, Math. Program. 106 (2006), doi 10.1007/s10107-004-0559-y: the barrier falls step by step, a filter
   judges trial points, and the curvature is shifted where it does not curve upwards. Inequalities have slacks, v = s,
   lower <= s <= upper; that of a variable's own bound is the variable itself. There is no restoration: where it would
   begin, the solver ends. Constants are those of the article and of IPOPT. */

enum { SOLVED, TOO_MANY, ACCEPTABLE, STUCK, LOST };

#define MARGIN 1e-2 /* of a start to its bounds, relative to them and to the room between */
#define FIRST_BARRIER 0.1
#define DAMPING 1e-5 /* of what has one bound */
#define LARGEST_DUALS 1e3 /* of a first estimate that is taken */
#define USUAL_DUALS 100.0 /* what is larger counts less in what is missed */
#define STEEPEST 100.0 /* of the cost at the start: more is scaled down to it */
#define MOST_SHIFT 1e20
#define REFINEMENTS 10
#define SOUND 1e-7 /* the same, with which no other factors are looked for */
#define REFINED 1e-12 /* of a step's conditions, relative to it */
#define SINGULAR 1e-5 /* the same, of a step that is none */
#define MOST_CORRECTIONS 4

/* Variables, slacks, and rows there; the cost, and the sum of what rows miss. */
typedef struct {
  double *x, *slack, *rows, cost, missed;
} point;

typedef struct {
  program *s;
  stage *stages;
  int n, equal, slacks;
  point at, trial;
  double *slope, *duals, *below, *above; /* of the cost; of rows; of the bounds of slacks */
  double *step, *step_slack, *new_duals, *sigma, *push; /* the step; curvature and slope of the barrier */
  double *right, *missed, *more, *more_duals, *of_cost, *of_rows, *kept, *scratch;
  double *filter;
  int filtered, room;
  double barrier, scale, shift, last_shift, dependent, share, most_missed, least_missed;
  void *memory;
} interior;

/* ---- memory ---- */

static double *take(double **from, long count) {
  double *mine = *from;
  *from += count;
  return mine;
}

EXPORT void stages_destroy(interior *p) {
  free(p->filter);
  free(p->stages);
  free(p->memory);
  free(p);
}

/* Where each array of the stages and of the method stands behind `from`; how many numbers they are. */
static long laid_out(interior *p, double *from) {
  const program *s = p->s;
  const int n = p->n, rows = p->equal + p->slacks;
  double *now = from;
  long most = 0;
  int k;
  for (k = 0; k < s->stages; ++k) {
    stage *a = p->stages + k;
    const int most_rows = a->g + a->next;
    a->curvature = take(&now, a->w * a->w), a->whole = take(&now, a->w * a->w);
    a->slopes = take(&now, (a->next + a->g + a->i) * a->w);
    a->rows = take(&now, most_rows * a->w), a->lower = take(&now, most_rows * most_rows);
    a->gain = take(&now, a->u * a->w), a->cost = take(&now, a->x * a->x);
    a->m = take(&now, a->w), a->d = take(&now, most_rows), a->t = take(&now, a->u);
    a->row = (int *)take(&now, most_rows), a->column = (int *)take(&now, a->u);
    if (2 * most_rows + a->w > most) most = 2 * most_rows + a->w;
  }
  p->scratch = take(&now, most);
  p->at.x = take(&now, n), p->trial.x = take(&now, n), p->step = take(&now, n), p->slope = take(&now, n);
  p->right = take(&now, n), p->more = take(&now, n), p->of_cost = take(&now, n);
  p->at.rows = take(&now, rows), p->trial.rows = take(&now, rows), p->duals = take(&now, rows);
  p->new_duals = take(&now, rows), p->missed = take(&now, rows), p->more_duals = take(&now, p->equal);
  p->of_rows = take(&now, p->equal), p->kept = take(&now, n + rows + p->slacks);
  p->at.slack = take(&now, p->slacks), p->trial.slack = take(&now, p->slacks), p->step_slack = take(&now, p->slacks);
  p->below = take(&now, p->slacks), p->above = take(&now, p->slacks);
  p->sigma = take(&now, p->slacks), p->push = take(&now, p->slacks);
  return now - from;
}

/* A solver; null where there is no memory for it. */
EXPORT interior *stages_create(program *s) {
  interior *p = calloc(1, sizeof *p);
  int k, next = 0, equal = 0;
  if (!p) return 0;
  p->s = s;
  p->n = s->primal_first[s->stages], p->equal = s->equal, p->slacks = s->slacks;
  p->stages = calloc((size_t)s->stages, sizeof *p->stages);
  for (k = 1; k < s->stages; ++k) equal += s->nx[k];
  for (k = 0; p->stages && k < s->stages; ++k) {
    stage *a = p->stages + k;
    a->w = own(s, k), a->x = k ? s->nx[k] : 0, a->u = a->w - a->x;
    a->next = k + 1 < s->stages ? s->nx[k + 1] : 0, a->g = s->ng[k], a->i = s->ni[k];
    a->at = s->primal_first[k], a->dynamics = next, a->equal = equal, a->unequal = p->equal + s->slack_first[k];
    next += a->next, equal += a->g;
  }
  if (p->stages) p->memory = malloc(sizeof(double) * (size_t)laid_out(p, 0));
  if (!p->memory) {
    stages_destroy(p);
    return 0;
  }
  laid_out(p, p->memory);
  return p;
}

/* ---- points ---- */

static double largest(const double *of, int n) {
  double found = 0.0;
  int i;
  for (i = 0; i < n; ++i) found = fmax(found, fabs(of[i]));
  return found;
}

static double room_below(const interior *p, double v, int i) {
  return fmax(v - p->s->lower[i], DBL_EPSILON * fmax(1.0, fabs(p->s->lower[i])));
}

static double room_above(const interior *p, double v, int i) {
  return fmax(p->s->upper[i] - v, DBL_EPSILON * fmax(1.0, fabs(p->s->upper[i])));
}

static int is_low(const interior *p, int i) { return p->s->lower[i] > -DBL_MAX; }
static int is_high(const interior *p, int i) { return p->s->upper[i] < DBL_MAX; }

/* Cost and rows of a point; 0 where they are no numbers. */
static int judged(interior *p, point *at) {
  int i;
  if (!objective(p->s, at->x, &at->cost) || !rows_of(p->s, at->x, at->rows)) return 0;
  at->cost *= p->scale;
  for (i = 0; i < p->slacks; ++i)
    if (p->s->own[i] >= 0) at->slack[i] = at->rows[p->equal + i];
  at->missed = 0.0;
  for (i = 0; i < p->equal; ++i) at->missed += fabs(at->rows[i]);
  for (i = 0; i < p->slacks; ++i) at->missed += fabs(at->rows[p->equal + i] - at->slack[i]);
  return 1;
}

/* The cost with its barrier. */
static double fenced(const interior *p, const point *at) {
  double sum = 0.0;
  int i;
  for (i = 0; i < p->slacks; ++i) {
    const double v = at->slack[i];
    if (is_low(p, i)) sum -= log(room_below(p, v, i)) - (is_high(p, i) ? 0.0 : DAMPING * room_below(p, v, i));
    if (is_high(p, i)) sum -= log(room_above(p, v, i)) - (is_low(p, i) ? 0.0 : DAMPING * room_above(p, v, i));
  }
  return at->cost + p->barrier * sum;
}

/* A value moved inside its bounds. */
static double inside(const interior *p, double v, int i) {
  const double low = p->s->lower[i], high = p->s->upper[i], width = MARGIN * (high - low);
  if (is_low(p, i)) v = fmax(v, low + fmin(MARGIN * fmax(1.0, fabs(low)), width));
  if (is_high(p, i)) v = fmin(v, high - fmin(MARGIN * fmax(1.0, fabs(high)), width));
  return v;
}

/* The slope of the Lagrangian in the variables, into `of_cost`. */
static void lagrangian(interior *p) {
  int i, k;
  memcpy(p->of_cost, p->slope, sizeof(double) * (size_t)p->n);
  for (k = 0; k < p->s->stages; ++k) {
    const stage *a = p->stages + k;
    const double *row = a->slopes;
    for (i = 0; i < a->next; ++i, row += a->w) {
      add(p->of_cost + a->at, p->duals[a->dynamics + i], row, a->w);
      p->of_cost[(a + 1)->at + (a + 1)->u + i] -= p->duals[a->dynamics + i];
    }
    for (i = 0; i < a->g; ++i, row += a->w) add(p->of_cost + a->at, p->duals[a->equal + i], row, a->w);
    for (i = 0; i < a->i; ++i, row += a->w) add(p->of_cost + a->at, p->duals[a->unequal + i], row, a->w);
  }
}

/* What the conditions of an optimum, with a barrier, are missed by (5). */
static double missing(interior *p, double barrier) {
  double of_slope, of_rows, of_bounds = 0.0, duals = 0.0, pushes = 0.0, all;
  int i, count = 0;
  lagrangian(p);
  of_slope = largest(p->of_cost, p->n);
  of_rows = largest(p->at.rows, p->equal);
  for (i = 0; i < p->equal + p->slacks; ++i) duals += fabs(p->duals[i]);
  for (i = 0; i < p->slacks; ++i) {
    const double v = p->at.slack[i];
    of_slope = fmax(of_slope, fabs(p->above[i] - p->below[i] - p->duals[p->equal + i]));
    of_rows = fmax(of_rows, fabs(p->at.rows[p->equal + i] - v));
    if (is_low(p, i)) of_bounds = fmax(of_bounds, fabs(p->below[i] * room_below(p, v, i) - barrier));
    if (is_high(p, i)) of_bounds = fmax(of_bounds, fabs(p->above[i] * room_above(p, v, i) - barrier));
    pushes += p->below[i] + p->above[i], count += is_low(p, i) + is_high(p, i);
  }
  all = (duals + pushes) / fmax(1.0, p->equal + p->slacks + count);
  of_slope /= fmax(USUAL_DUALS, all) / USUAL_DUALS;
  of_bounds /= fmax(USUAL_DUALS, pushes / fmax(1.0, count)) / USUAL_DUALS;
  return fmax(of_slope, fmax(of_rows, of_bounds));
}

/* ---- the step ---- */

/* Curvature and slope of the barrier in the slacks. */
static void fence(interior *p) {
  int i;
  for (i = 0; i < p->slacks; ++i) {
    const double v = p->at.slack[i];
    p->sigma[i] = p->push[i] = 0.0;
    if (is_low(p, i)) {
      p->sigma[i] += p->below[i] / room_below(p, v, i);
      p->push[i] -= p->barrier / room_below(p, v, i) - (is_high(p, i) ? 0.0 : DAMPING * p->barrier);
    }
    if (is_high(p, i)) {
      p->sigma[i] += p->above[i] / room_above(p, v, i);
      p->push[i] += p->barrier / room_above(p, v, i) - (is_low(p, i) ? 0.0 : DAMPING * p->barrier);
    }
  }
}

/* The curvature of the slacks on that of the variables. */
static void condense(interior *p) {
  int i, k, r;
  for (k = 0; k < p->s->stages; ++k) {
    const stage *a = p->stages + k;
    const double *row = a->slopes + (a->next + a->g) * a->w;
    for (i = 0; i < a->i; ++i, row += a->w)
      for (r = 0; r < a->w; ++r)
        if (row[r] != 0.0) add(a->curvature + r * a->w, p->sigma[a->unequal - p->equal + i] * row[r], row, a->w);
  }
}

/* The step and new multipliers, by the factors at hand, where rows miss `missed`; how much they miss, relatively. */
static double direction(interior *p, const double *missed) {
  const int count = p->s->stages;
  double size, left = 0.0, before = INFINITY;
  int i, k, round;
  memcpy(p->right, p->slope, sizeof(double) * (size_t)p->n);
  for (k = 0; k < count; ++k) {
    const stage *a = p->stages + k;
    const double *row = a->slopes + (a->next + a->g) * a->w;
    for (i = 0; i < a->i; ++i, row += a->w) {
      const int of = a->unequal - p->equal + i;
      add(p->right + a->at, p->sigma[of] * missed[a->unequal + i] + p->push[of], row, a->w);
    }
  }
  solved_stages(p->stages, count, p->right, missed, p->step, p->new_duals, p->scratch);
  size = fmax(largest(p->right, p->n), largest(missed, p->equal));
  size += fmin(fmax(largest(p->step, p->n), largest(p->new_duals, p->equal)), 1e6 * size);
  for (round = 0;; ++round) {
    left = left_of(p->stages, count, p->shift, p->right, missed, p->step, p->new_duals, p->of_cost, p->of_rows);
    if (!(left > REFINED * size) || !(left < before / 2) || round == REFINEMENTS) break;
    before = left;
    solved_stages(p->stages, count, p->of_cost, p->of_rows, p->more, p->more_duals, p->scratch);
    add(p->step, 1.0, p->more, p->n);
    add(p->new_duals, 1.0, p->more_duals, p->equal);
  }
  for (k = 0; k < count; ++k) {
    const stage *a = p->stages + k;
    const double *row = a->slopes + (a->next + a->g) * a->w;
    for (i = 0; i < a->i; ++i, row += a->w) {
      const int of = a->unequal - p->equal + i;
      p->step_slack[of] = missed[a->unequal + i] + dot(row, p->step + a->at, a->w);
      p->new_duals[a->unequal + i] = p->sigma[of] * p->step_slack[of] + p->push[of];
    }
  }
  return size > 0.0 ? left / size : 0.0;
}

/* What the rows miss at a point. */
static void misses(const interior *p, const point *at, double *out) {
  int i;
  memcpy(out, at->rows, sizeof(double) * (size_t)(p->equal + p->slacks));
  for (i = 0; i < p->slacks; ++i) out[p->equal + i] -= at->slack[i];
}

/* The step, of a curvature that is shifted as far as it curves upwards (IC); what it misses, 1 where none is found. */
static double shifted(interior *p) {
  for (p->shift = 0.0; p->shift < MOST_SHIFT;) {
    if (must_end(p->s)) return 1.0;
    if (factorised_stages(p->stages, p->s->stages, p->shift, p->dependent, p->scratch)) {
      const double left = direction(p, p->missed);
      return left < SINGULAR ? left : 1.0;
    }
    if (p->shift > 0.0) p->shift *= p->last_shift > 0.0 ? 8.0 : 100.0;
    else p->shift = p->last_shift > 0.0 ? fmax(1e-20, p->last_shift / 3.0) : 1e-4;
  }
  return 1.0;
}

/* The same by factors that are sound, or the best there are; 0 where there are none. */
static int stepped(interior *p) {
  const double others[] = {1e-5, 1e-8, 1e-3};
  double best = p->dependent, left;
  int i;
  misses(p, &p->at, p->missed);
  left = shifted(p);
  for (i = 0; i < 3 && left > SOUND && !p->s->stopped; ++i) {
    double now;
    if (others[i] == best) continue;
    p->dependent = others[i];
    now = shifted(p);
    if (now < left) left = now, best = others[i];
  }
  if (p->dependent != best) {
    p->dependent = best;
    left = shifted(p);
  }
  if (p->shift > 0.0 && left < 1.0) p->last_shift = p->shift;
  return left < 1.0 && !p->s->stopped;
}

/* How far slacks may go along the step, to `share` of their room. */
static double reach(const interior *p, double share) {
  double most = 1.0;
  int i;
  for (i = 0; i < p->slacks; ++i) {
    const double move = p->step_slack[i], v = p->at.slack[i];
    if (move < 0.0 && is_low(p, i)) most = fmin(most, -share * room_below(p, v, i) / move);
    if (move > 0.0 && is_high(p, i)) most = fmin(most, share * room_above(p, v, i) / move);
  }
  return most;
}

/* Multipliers of bounds at the trial point, `share` of the way to zero at most, and near those of the barrier (16). */
static void push(interior *p, double share) {
  double most = 1.0;
  int i, side;
  for (i = 0; i < p->slacks; ++i) {
    const double v = p->at.slack[i], move = p->step_slack[i];
    const double low = (p->barrier - p->below[i] * move) / room_below(p, v, i) - p->below[i];
    const double high = (p->barrier + p->above[i] * move) / room_above(p, v, i) - p->above[i];
    if (is_low(p, i) && low < 0.0) most = fmin(most, -share * p->below[i] / low);
    if (is_high(p, i) && high < 0.0) most = fmin(most, -share * p->above[i] / high);
  }
  for (i = 0; i < p->slacks; ++i) {
    const double v = p->at.slack[i], move = p->step_slack[i];
    for (side = 0; side < 2; ++side) {
      double *mine = side ? p->above : p->below;
      const double before = side ? room_above(p, v, i) : room_below(p, v, i);
      const double now = side ? room_above(p, p->trial.slack[i], i) : room_below(p, p->trial.slack[i], i);
      if (side ? !is_high(p, i) : !is_low(p, i)) continue;
      mine[i] += most * ((p->barrier + (side ? 1.0 : -1.0) * mine[i] * move) / before - mine[i]);
      mine[i] = fmax(fmin(mine[i], 1e10 * p->barrier / now), 1e-10 * p->barrier / now);
    }
  }
}

/* ---- the search along it ---- */

static void tried(interior *p, double share) {
  int i;
  p->share = share;
  for (i = 0; i < p->n; ++i) p->trial.x[i] = p->at.x[i] + share * p->step[i];
  for (i = 0; i < p->slacks; ++i) p->trial.slack[i] = p->at.slack[i] + share * p->step_slack[i];
}

static int passes(const interior *p, double missed, double cost) {
  int i;
  if (missed > p->most_missed) return 0;
  for (i = 0; i < p->filtered; ++i)
    if (missed > p->filter[2 * i] && cost > p->filter[2 * i + 1]) return 0;
  return 1;
}

static int kept_out(interior *p, double missed, double cost) {
  if (p->filtered == p->room) {
    double *more = realloc(p->filter, sizeof(double) * 2 * (size_t)(p->room + 64));
    if (!more) return 0;
    p->filter = more, p->room += 64;
  }
  p->filter[2 * p->filtered] = missed, p->filter[2 * p->filtered++ + 1] = cost;
  return 1;
}

/* Whether the trial point, `share` of the step away, is better: cost falls, or what is missed does (18, 20). */
static int better(interior *p, double cost, double falls, double share) {
  const double now = fenced(p, &p->trial), missed = p->at.missed, rounding = 10 * DBL_EPSILON * fabs(cost);
  const int steep = falls < 0.0 && share * pow(-falls, 2.3) > pow(missed, 1.1);
  if (!isfinite(now) || !passes(p, p->trial.missed, now - rounding)) return 0;
  if (steep && missed <= p->least_missed) return now - cost - rounding <= 1e-8 * share * falls;
  if (p->trial.missed > (1.0 - 1e-5) * missed + 10 * DBL_EPSILON * missed && now - cost - rounding > -1e-8 * missed)
    return 0;
  if (!steep || now - cost - rounding > 1e-8 * share * falls)
    return kept_out(p, (1.0 - 1e-5) * missed, cost - 1e-8 * missed);
  return 1;
}

/* A trial point that is better; 0 where there is none. */
static int searched(interior *p, double share) {
  const int n = p->n, rows = p->equal + p->slacks;
  const double cost = fenced(p, &p->at), whole = reach(p, share);
  const double falls = dot(p->slope, p->step, n) + dot(p->push, p->step_slack, p->slacks), missed = p->at.missed;
  double least = 1e-5, now;
  int i;
  if (falls < 0.0) {
    least = fmin(least, 1e-8 * missed / -falls);
    if (missed <= p->least_missed) least = fmin(least, pow(missed, 1.1) / pow(-falls, 2.3));
  }
  least *= 0.05;
  for (now = whole; now >= least && now > DBL_EPSILON; now /= 2) {
    int fits;
    if (must_end(p->s)) return 0;
    tried(p, now);
    fits = judged(p, &p->trial);
    if (fits && better(p, cost, falls, now)) return 1;
    if (now == whole && fits && p->trial.missed >= missed) { /* what the rows' own curvature misses, off the step */
      double before = missed;
      int round;
      memcpy(p->kept, p->step, sizeof(double) * (size_t)n);
      memcpy(p->kept + n, p->new_duals, sizeof(double) * (size_t)rows);
      memcpy(p->kept + n + rows, p->step_slack, sizeof(double) * (size_t)p->slacks);
      for (round = 0; round < MOST_CORRECTIONS; ++round) {
        double along = round ? reach(p, share) : now;
        for (i = 0; i < rows; ++i) p->missed[i] *= along;
        for (i = 0; i < rows; ++i)
          p->missed[i] += p->trial.rows[i] - (i < p->equal ? 0.0 : p->trial.slack[i - p->equal]);
        if (must_end(p->s) || !(direction(p, p->missed) < SINGULAR)) break;
        tried(p, reach(p, share));
        if (!judged(p, &p->trial)) break;
        if (better(p, cost, falls, now)) return 1;
        if (p->trial.missed > 0.99 * before) break;
        before = p->trial.missed;
      }
      memcpy(p->step, p->kept, sizeof(double) * (size_t)n);
      memcpy(p->new_duals, p->kept + n, sizeof(double) * (size_t)rows);
      memcpy(p->step_slack, p->kept + n + rows, sizeof(double) * (size_t)p->slacks);
    }
  }
  return 0;
}

/* ---- the solve ---- */

static int sloped(interior *p) {
  int i;
  if (!slope(p->s, p->at.x, p->slope) || !slopes_of_rows(p->s, p->at.x, p->stages)) return 0;
  for (i = 0; i < p->n; ++i) p->slope[i] *= p->scale;
  return 1;
}

/* Multipliers with which the slope of the Lagrangian is least (36). */
static void estimate(interior *p) {
  int i, k;
  for (k = 0; k < p->s->stages; ++k) {
    const stage *a = p->stages + k;
    memset(a->curvature, 0, sizeof(double) * (size_t)(a->w * a->w));
    for (i = 0; i < a->w; ++i) a->curvature[i * a->w + i] = 1.0;
  }
  for (i = 0; i < p->slacks; ++i) p->sigma[i] = 1.0, p->push[i] = p->above[i] - p->below[i];
  condense(p);
  memset(p->missed, 0, sizeof(double) * (size_t)(p->equal + p->slacks));
  p->shift = 0.0;
  memset(p->duals, 0, sizeof(double) * (size_t)(p->equal + p->slacks));
  if (!factorised_stages(p->stages, p->s->stages, 0.0, p->dependent, p->scratch)) return;
  if (!(direction(p, p->missed) < SINGULAR)) return;
  if (largest(p->new_duals, p->equal + p->slacks) <= LARGEST_DUALS)
    memcpy(p->duals, p->new_duals, sizeof(double) * (size_t)(p->equal + p->slacks));
}

/* The first point; 0 where its numbers are none. */
static int begun(interior *p) {
  program *s = p->s;
  int i;
  for (i = 0; i < s->inner_first[s->stages]; ++i)
    s->before[s->primal_first[s->stages] + i] = s->x[s->inner_variable[i]] / s->a[s->inner_variable[i]];
  s->known = s->factored = s->stopped = 0;
  memcpy(p->at.x, s->guess, sizeof(double) * (size_t)p->n);
  for (i = 0; i < p->slacks; ++i)
    if (s->own[i] >= 0) p->at.x[s->own[i]] = inside(p, p->at.x[s->own[i]], i);
  p->scale = 1.0, p->barrier = FIRST_BARRIER, p->filtered = 0, p->last_shift = 0.0, p->dependent = 1e-5;
  if (!judged(p, &p->at) || !sloped(p)) return 0;
  p->scale = fmin(1.0, STEEPEST / fmax(STEEPEST, largest(p->slope, p->n)));
  for (i = 0; i < p->n; ++i) p->slope[i] *= p->scale;
  for (i = 0; i < p->slacks; ++i) {
    if (s->own[i] < 0) p->at.slack[i] = inside(p, p->at.rows[p->equal + i], i);
    p->below[i] = is_low(p, i), p->above[i] = is_high(p, i);
  }
  if (!judged(p, &p->at)) return 0;
  p->most_missed = 1e4 * fmax(1.0, p->at.missed), p->least_missed = 1e-4 * fmax(1.0, p->at.missed);
  estimate(p);
  return 1;
}

static int run(interior *p, double tolerance, int most, double nearly, int patience, int *count) {
  int i, near = 0, tiny = 0;
  if (!begun(p)) return LOST;
  for (*count = 0;; ++*count) {
    const double missed = missing(p, 0.0);
    double share;
    if (missed <= tolerance) return SOLVED;
    near = missed <= nearly ? near + 1 : 0;
    if (near && near == patience) return ACCEPTABLE;
    p->s->cost = p->at.cost / p->scale * p->s->cost_scale;
    misses(p, &p->at, p->missed);
    p->s->missed = largest(p->missed, p->equal + p->slacks);
    if (*count >= most || ends(p->s, 1)) return TOO_MANY;
    while (p->barrier > tolerance / 11 && (tiny || missing(p, p->barrier) <= 10 * p->barrier)) {
      p->barrier = fmax(tolerance / 11, fmin(0.2 * p->barrier, pow(p->barrier, 1.5)));
      p->filtered = tiny = 0;
    }
    if (tiny > 1) return missed <= nearly ? ACCEPTABLE : STUCK;
    if (!curvature(p->s, p->scale, p->at.x, p->duals, p->stages)) return LOST;
    fence(p);
    condense(p);
    if (!stepped(p)) return p->s->stopped ? TOO_MANY : LOST;
    share = fmax(0.99, 1.0 - p->barrier);
    for (i = 0; i < p->n && fabs(p->step[i]) < 10 * DBL_EPSILON * (1.0 + fabs(p->at.x[i])); ++i) {}
    tiny = i == p->n && p->at.missed < 1e-4 ? tiny + 1 : 0;
    if (tiny) {
      tried(p, reach(p, share));
      if (!judged(p, &p->trial)) return STUCK;
    } else if (!searched(p, share)) {
      return p->s->stopped ? TOO_MANY : missed <= nearly ? ACCEPTABLE : STUCK;
    }
    push(p, share);
    {
      const point now = p->at;
      p->at = p->trial, p->trial = now;
      for (i = 0; i < p->equal + p->slacks; ++i) p->duals[i] += p->share * (p->new_duals[i] - p->duals[i]);
    }
    if (!sloped(p)) return LOST;
  }
}

/* Solve to a tolerance, within so many iterations; so many times in a row `nearly` is enough. `told`: how it ended;
   iterations. */
EXPORT void stages_solve(interior *p, double tolerance, int most, double nearly, int patience, double *primal, double *dual, int *told) {
  int i;
  memset(primal, 0, sizeof(double) * (size_t)p->n);
  memset(p->duals, 0, sizeof(double) * (size_t)(p->equal + p->slacks));
  told[1] = 0;
  told[0] = run(p, tolerance, most, nearly, patience, told + 1);
  memcpy(primal, p->at.x, sizeof(double) * (size_t)p->n);
  for (i = 0; i < p->equal + p->slacks; ++i) dual[i] = p->duals[i] / p->scale;
}

/* Cost (scaled); rows and their multipliers (as they are, in `g` and `lam`) at some variables. */
EXPORT void stages_values(program *s, const double *primal, const double *dual, double *cost) {
  *cost = NAN;
  objective(s, primal, cost);
  memset(s->lam, 0, sizeof(double) * (size_t)s->rows);
  if (slopes_at(s, primal)) multipliers(s, 1.0, dual);
}

/* One sample's optimisation: linearise along the last plan, condense, solve one QP, simulate its plan.
 *
 * Unknowns are the drives' block values z in fractions of their range.  With y(z) ~ y0 + G (z - z0) and W the
 * weights of the samples,
 *
 *     H = 2 ( G'WG + move D'D + drive L ),     f = 2 ( G'W (y0 - G z0 - r) - move D'e ).
 *
 * G is propagated as tangents of the step, a column for each drive of each block that has begun.  Its rows are the
 * soft rows of the program, for each sample those of the controlled, then of the limited outputs; the rows of four
 * samples are as long as the longest of them, so that what is added up over samples is added up for four at once.
 * A Peltier's gain falls in proportion to its drive: the gain along the guess gives the drive at which a quarter
 * remains, and no block goes further.  Where the simulated cost of the QP's plan is above that of the guess, shorter
 * moves are tried too, and every fifth sample plain ramps: near the optimum of a Peltier element the
 * linearisation overestimates the effect, and beyond it the gain changes sign.
 * Of a linear plant G, and the factor of H while the weights stay, are made once, what the state makes of the outputs
 * is in the design, and the QP's plan is the best.
 */
#include "tg_controller.h"
#include "tg_model.h"

#include <math.h>
#include <string.h>

#define NONE 1e30

static int row_of(const tg_design *s, int r) { return r < s->n_c ? s->controlled[r] : s->limited[r - s->n_c]; }

/* What all outputs read: of one state each, or of all between two, and a level. */
typedef struct {
    double level[TG_NY], share[TG_NY];
    int from[TG_NY], single;
} tg_outputs;

static void set_outputs(const tg_design *s, const double *bias, tg_outputs *of)
{
    of->single = 1;
    for (int i = 0; i < TG_NY; i++) {
        of->from[i] = s->read_from[i];
        of->share[i] = s->C[i * TG_NX + of->from[i]];
        of->level[i] = s->y0[i] + bias[i];
        of->single = of->single && s->read_to[i] <= of->from[i] + 1;
    }
}

static void read_outputs(const tg_design *s, const tg_outputs *of, const double *x, double *y)
{
    for (int i = 0; i < TG_NY; i++)
        y[i] = of->level[i] + of->share[i] * x[of->from[i]];
    for (int i = 0; !of->single && i < TG_NY; i++)
        for (int j = of->from[i] + 1; j < s->read_to[i]; j++)
            y[i] += s->C[i * TG_NX + j] * x[j];
}

static const double *response(const tg_controller *c, int k, int r)
{
    const tg_design *s = c->design;
    return c->G + c->qp.start[k * (s->n_c + s->n_l) + r];
}

/* How long the rows of sample k are. */
static int length(const tg_controller *c, int k) { return c->qp.filled[k * (c->design->n_c + c->design->n_l)]; }

/* Say where the rows of the response begin, and how long they are: in four samples as long as in the last. */
static void lay_out(tg_controller *c)
{
    const tg_design *s = c->design;
    int k = 0, i = 0, at = 0;
    if (c->laid_out)
        return;
    for (int b = 0, done = 0; b < s->n_b; b++)
        for (int left = s->blocks[b]; left > 0; left--, done++) {
            if (done % 4 != 3 && done != s->N - 1)
                continue;
            for (; k <= done; k++)
                for (int r = 0; r < s->n_c + s->n_l; r++, i++) {
                    c->qp.start[i] = at;
                    c->qp.filled[i] = TG_WHOLE((b + 1) * TG_NU);
                    at += c->qp.filled[i];
                }
        }
    c->qp.A = c->G;
    c->laid_out = 1;
}

/* In samples, by how much more or less than in one the first move may go. */
static double more_slew(const tg_controller *c)
{
    return c->slew_s > 0.0 ? c->slew_s / c->design->dt - 1.0 : 0.0;
}

/* A drive whose output has no reading goes to rest, as fast as the slew allows. */
static int is_parked(const tg_controller *c, int j) { return c->lost[c->design->pair[j]]; }

static void park(const tg_controller *c, const double *last, double *plan)
{
    const tg_design *s = c->design;
    for (int b = 0; b < s->n_b; b++)
        for (int j = 0; j < TG_NU; j++)
            if (is_parked(c, j)) {
                double room = (s->reach[b] + more_slew(c)) * s->slew[j];
                plan[b * TG_NU + j] = fmin(fmax(s->safe[j], last[j] - room), last[j] + room);
            }
}

/* The drives of a block and of the next ones, four at most, biases included; return of how many. */
static int drives_of(const tg_controller *c, const double *plan, const double *drive_bias, int b, double *u)
{
    int blocks = c->design->n_b - b < 4 ? c->design->n_b - b : 4;
    for (int i = 0; i < blocks * TG_NU; i++)
        u[i] = plan[b * TG_NU + i] + drive_bias[i % TG_NU];
    return blocks;
}

void tg_simulate(tg_controller *c, const double *start, const double *plan, const double *drive_bias, const double *d,
                 const double *bias, double *y)
{
    const tg_design *s = c->design;
    double both[2][TG_NX], *x = both[0], *next = both[1], four[4 * TG_NU];
    tg_outputs outputs;
    int k = 0;
    memcpy(x, start, sizeof both[0]);
    set_outputs(s, bias, &outputs);
    for (int b = 0; b < s->n_b; b++) {
        const double *u = four + b % 4 * TG_NU, *h = c->by_drives + b % 4;
        if (b % 4 == 0)
            tg_model_hold(drives_of(c, plan, drive_bias, b, four), four, s->k, c->by_drives);
        for (int at = 0; at < s->blocks[b]; at++, k++) {
            for (int part = 0; part < s->sub; part++) {
                double *swap = x;
                tg_model_step(x, u, d, s->k, h, next);
                x = next;
                next = swap;
            }
            read_outputs(s, &outputs, x, y + k * TG_NY);
        }
    }
}

/* Add a share of one state's groups of four columns to a row. */
static void add_row(double *restrict into, double share, const double *restrict from, int groups)
{
    for (int g = 0; g < groups; g++)
        for (int i = 0; i < 4; i++)
            into[4 * g + i] += share * from[4 * TG_NX * g + i];
}

/* What output i shows of the columns that have begun, into a row; zeros behind. */
static void read_row(const tg_design *s, int i, const double *now, int groups, double *restrict into, int filled)
{
    const double *C = s->C + i * TG_NX;
    int j = s->read_from[i];
    const double *restrict from = now + 4 * j;
    const double share = C[j];
    for (int g = 0; g < groups; g++)
        for (int l = 0; l < 4; l++)
            into[4 * g + l] = share * from[4 * TG_NX * g + l];
    for (int l = 4 * groups; l < filled; l++)
        into[l] = 0.0;
    while (++j < s->read_to[i])
        add_row(into, C[j], now + 4 * j, groups);
}

/* Drives of a block as directions of the groups of four columns that they are in. */
static void seed_drives(tg_controller *c, int begun)
{
    memset(c->seed_u, 0, (size_t)(TG_WHOLE(begun % 4 + TG_NU) * TG_NU) * sizeof(double));
    for (int j = 0; j < TG_NU; j++) {
        int column = begun % 4 + j;
        c->seed_u[(column / 4) * 4 * TG_NU + 4 * j + column % 4] = c->design->span[j];
    }
}

/* Outputs of the guess, and G with its columns in fractions of the drives' ranges. */
static void linearise(tg_controller *c, const double *start, const double *guess, const double *drive_bias,
                      const double *d, const double *bias)
{
    const tg_design *s = c->design;
    double both[2][TG_NX], *x = both[0], *next = both[1], four[4 * TG_NU];
    double *now = c->seed, *then = c->seed + TG_NX * TG_WIDE;
    tg_outputs outputs;
    int k = 0, rows = s->n_c + s->n_l;
    const int *from = c->qp.start, *filled = c->qp.filled;
    memcpy(x, start, sizeof both[0]);
    set_outputs(s, bias, &outputs);
    lay_out(c);
    for (int b = 0, groups = 0; b < s->n_b; b++) {
        int begun = b * TG_NU, before = begun / 4 * 4 * TG_NX, needed = TG_WHOLE(begun + TG_NU) / 4;
        const double *u = four + b % 4 * TG_NU, *h = c->by_drives + b % 4;
        seed_drives(c, begun);
        for (; groups < needed; groups++)
            memset(now + groups * 4 * TG_NX, 0, 4 * TG_NX * sizeof(double));
        if (b % 4 == 0)
            tg_model_hold_slopes(drives_of(c, guess, drive_bias, b, four), four, s->k, c->by_drives);
        for (int at = 0; at < s->blocks[b]; at++, k++) {
            for (int part = 0; part < s->sub; part++) {
                double *swap = now, *last = x;
                tg_model_partials(x, u, d, s->k, h, next, c->partials);
                tg_model_tangent(begun / 4, c->partials, s->k, h, now, then);
                tg_model_tangent_u(groups - begun / 4, c->partials, s->k, h, now + before, c->seed_u, then + before);
                x = next;
                next = last;
                now = then;
                then = swap;
            }
            read_outputs(s, &outputs, x, c->y_guess + k * TG_NY);
            for (int r = 0; r < rows; r++, from++, filled++)
                read_row(s, row_of(s, r), now, groups, c->G + *from, *filled);
        }
    }
}

/* Each block's response, summed over time, over that at rest; 1 where the horizon hides it. */
static void find_authority(tg_controller *c)
{
    const tg_design *s = c->design;
    double sums[TG_Q_W];
    for (int r = 0; r < s->n_c; r++) {
        int k = 0, apart;
        memset(sums, 0, sizeof sums);
        for (; k + 4 <= s->N; k += 4) {
            apart = (s->n_c + s->n_l) * length(c, k);
            tg_add_four(sums, response(c, k, r), apart, 1.0, 1.0, 1.0, 1.0, length(c, k));
        }
        for (; k < s->N; k++)
            tg_add_row(sums, 1.0, response(c, k, r), length(c, k));
        for (int at = 0; at < s->n_b * TG_NU; at++)
            if (s->strongest[at % TG_NU] == r)
                c->authority[at] = s->seen[at] ? sums[at] / s->at_rest[at] : 1.0;
    }
}

/* The targets of controlled output r in the prediction: the first one, and how far they are apart. */
static const double *goals_of(const tg_controller *c, const double *target, int r, int *apart)
{
    *apart = c->design->n_c;
#if TG_NR > 0
    if (c->ramps)
        return c->path + r;
#endif
    if (c->goals)
        return c->goals + r;
    *apart = 0;
    return target + r;
}

/* By how much a soft row is exceeded where that costs as much by itself as by its square. */
static double first(const tg_design *s)
{
    return 1.0 / sqrt(s->price > TG_SHORTEST ? s->price : TG_SHORTEST);
}

/* What values, TG_NY apart, cost that are less than low or more than high. */
static double cost_beyond(const tg_design *s, const double *values, double low, double high)
{
    double cost = 0.0, one = first(s);
    for (int k = 0; k < s->N; k++) {
        double under = low - values[k * TG_NY], over = values[k * TG_NY] - high;
        if (under > 0.0)
            cost += one * under + under * under;
        if (over > 0.0)
            cost += one * over + over * over;
    }
    return cost;
}

/* What the errors of controlled output r cost. */
static double cost_of(const tg_controller *c, const double *values, const double *goal, int apart, int r, double side)
{
    const tg_design *s = c->design;
    double sum = 0.0, over = 0.0, last = 0.0, one = first(s);
    if (s->zone[r] > 0.0) {
        for (int k = 0; k < s->N; k++) {
            double slack = fabs(values[k * TG_NY] - goal[k * apart]) - s->zone[r];
            last = slack > 0.0 ? slack + slack * slack : 0.0;
            sum += last;
        }
        return s->weight[r] * (s->track * sum + s->terminal * last);
    }
    for (int k = 0; k < s->N; k++) {
        double error = values[k * TG_NY] - goal[k * apart], slack = side * error - s->overshoot;
        last = error * error;
        sum += last;
        if (slack > 0.0 && side != 0.0)
            over += one * slack + slack * slack;
    }
    return s->weight[r] * (s->track * sum + s->terminal * last) + s->price * over;
}

/* The cost of a plan whose outputs y were simulated. */
static double merit(const tg_controller *c, const double *plan, const double *y, const double *target,
                    const double *side, const double *last)
{
    const tg_design *s = c->design;
    double cost = 0.0;
    for (int b = 0; b < s->n_b; b++)
        for (int j = 0; j < TG_NU; j++) {
            double value = plan[b * TG_NU + j], energy = s->energy[j] * s->blocks[b];
            double step = (value - (b ? plan[(b - 1) * TG_NU + j] : last[j])) / s->span[j];
            cost += s->move * step * step;
            value /= s->span[j];
            cost += s->drive * value * value * s->blocks[b] + energy * value;
        }
    for (int r = 0, apart; r < s->n_c; r++)
        if (!c->lost[r]) {
            const double *goal = goals_of(c, target, r, &apart);
            cost += cost_of(c, y + s->controlled[r], goal, apart, r, side[r]);
        }
    for (int r = 0; r < s->n_l; r++)
        cost += s->dear[r] * cost_beyond(s, y + s->limited[r], s->limit_low[r], s->limit_high[r]);
    return cost;
}

/* Of the way to an optimum, that a drive may go. */
static double allowed_share(double end, double best, double span)
{
    double share = end / fmax(best, 1e-9 * span);
    return fmax(TG_SAFE, fmin(share, 3.0 - 2.0 * share));
}

static void set_bounds(tg_controller *c, const double *guess, const double *drive_bias, const double *last)
{
    const tg_design *s = c->design;
    tg_qp *q = &c->qp;
    double more = more_slew(c);
    for (int b = 0; b < s->n_b; b++)
        for (int j = 0; j < TG_NU; j++) {
            int at = b * TG_NU + j;
            double away = guess[at] - s->begin[j], lost = 1.0 - c->authority[at];
            double low = s->lowest[j], high = s->highest[j];
            double gap = (s->reach[b] - (b ? s->reach[b - 1] : -more)) * s->slew[j];
            double before = b ? 0.0 : last[j];
            if (lost > TG_FADING && fabs(away) > TG_LITTLE * s->span[j]) {
                double best = fabs(away + drive_bias[j]) / lost, held = last[j] - s->begin[j];
                double end = fabs((away < 0.0 ? low : high) - s->begin[j]);
                double room = best * allowed_share(end, best, s->span[j]);
                double still = away * held > 0.0 ? fabs(held) - (s->reach[b] + more) * s->slew[j] : 0.0;
                if (room < still)
                    room = still; /* what the slew allows */
                if (away < 0.0 && s->begin[j] - room > low)
                    low = s->begin[j] - room;
                if (away > 0.0 && s->begin[j] + room < high)
                    high = s->begin[j] + room;
            }
            if (is_parked(c, j)) {
                low = guess[at] - TG_LITTLE * s->span[j];
                high = guess[at] + TG_LITTLE * s->span[j];
            }
            q->lower[at] = low / s->span[j];
            q->upper[at] = high / s->span[j];
            q->lower[q->n + at] = (before - gap) / s->span[j];
            q->upper[q->n + at] = (before + gap) / s->span[j];
        }
}

/* Weight of the error of a controlled output in sample k; 0 where it is lost, or has a zone. */
static double weight_of(const tg_controller *c, int k, int r)
{
    const tg_design *s = c->design;
    return c->lost[r] || s->zone[r] > 0.0 ? 0.0 : 2.0 * s->weight[r] * (s->track + (k == s->N - 1 ? s->terminal : 0.0));
}

static void set_linear_cost(tg_controller *c, const double *target, const double *last)
{
    const tg_design *s = c->design;
    tg_qp *q = &c->qp;
    memset(q->f, 0, sizeof q->f);
    for (int i = 0; i < q->n; i++)
        q->f[i] = s->energy[i % TG_NU] * s->blocks[i / TG_NU];
    for (int r = 0, apart, rows = s->n_c + s->n_l; r < s->n_c; r++) {
        const double *goal = goals_of(c, target, r, &apart);
        for (int k = 0; k < s->N; k += 4) {
            const double *g = response(c, k, r), *free = c->free + k * rows + r;
            double error[4] = {0.0};
            int n = s->N - k < 4 ? s->N - k : 4, beside = rows * length(c, k);
            for (int i = 0; i < n; i++)
                error[i] = weight_of(c, k + i, r) * (free[i * rows] - goal[(k + i) * apart]);
            if (n == 4)
                tg_add_four(q->f, g, beside, error[0], error[1], error[2], error[3], length(c, k));
            for (int i = 0; n < 4 && i < n; i++)
                tg_add_row(q->f, error[i], g + i * beside, length(c, k));
        }
    }
    for (int j = 0; j < TG_NU; j++)
        q->f[j] -= 2.0 * s->move * last[j] / s->span[j];
}

/* Sum up over n rows of the response, begun at start, apart apart, the products of their numbers i to i + 3 with j to
 * j + 3, and with those of `beside`, into 4 rows of 8: all sums stay in registers. */
static void sum_products(const double *restrict G, const int *restrict start, int apart, int n, int i, int j, int beside,
                         double *restrict out)
{
    double a0[4] = {0.0}, a1[4] = {0.0}, a2[4] = {0.0}, a3[4] = {0.0};
    double b0[4] = {0.0}, b1[4] = {0.0}, b2[4] = {0.0}, b3[4] = {0.0};
    for (; n > 0; n--, start += apart) {
        const double *g = G + *start + j, *h = G + *start + beside, *v = G + *start + i;
        const double v0 = v[0], v1 = v[1], v2 = v[2], v3 = v[3];
        for (int l = 0; l < 4; l++) {
            a0[l] += v0 * g[l];
            a1[l] += v1 * g[l];
            a2[l] += v2 * g[l];
            a3[l] += v3 * g[l];
            b0[l] += v0 * h[l];
            b1[l] += v1 * h[l];
            b2[l] += v2 * h[l];
            b3[l] += v3 * h[l];
        }
    }
    for (int l = 0; l < 4; l++) {
        out[l] = a0[l];
        out[4 + l] = b0[l];
        out[8 + l] = a1[l];
        out[12 + l] = b1[l];
        out[16 + l] = a2[l];
        out[20 + l] = b2[l];
        out[24 + l] = a3[l];
        out[28 + l] = b3[l];
    }
}

/* Add what the errors of controlled output r cost to the lower triangle of H, four rows and eight columns at once; the
 * first output's is put there. */
static void add_squares(tg_controller *c, int r)
{
    static const double none[8] = {0.0};
    tg_qp *q = &c->qp;
    const int rows = c->design->n_c + c->design->n_l, last = c->design->N - 1;
    const int *start = q->start + r, *filled = q->filled + r;
    const double weight = weight_of(c, 0, r), at_last = weight_of(c, last, r), *end = c->G + start[last * rows];
    double sums[32];
    if (r && !(at_last > 0.0)) /* lost, or of a zone */
        return;
    for (int i = 0, first = 0; i < q->n; i += 4) {
        for (; first < last && *filled <= i; first++)
            filled += rows;
        for (int j = 0; j <= i; j += 8) {
            const int wide = j + 4 <= i ? 8 : 4;
            sum_products(c->G, start + first * rows, rows, last - first, i, j, j + wide - 4, sums);
            for (int a = 0; a < 4 && i + a < q->n; a++) {
                double *row = q->H + (size_t)(i + a) * TG_Q_W + j;
                const double own = at_last * end[i + a], *before = r ? row : none;
                for (int l = 0; l < wide; l++)
                    row[l] = before[l] + weight * sums[8 * a + l] + own * end[j + l];
            }
        }
    }
}

static void set_quadratic_cost(tg_controller *c)
{
    const tg_design *s = c->design;
    tg_qp *q = &c->qp;
    for (int r = 0; r < s->n_c; r++)
        add_squares(c, r);
    for (int b = 0; b < s->n_b; b++)
        for (int j = 0; j < TG_NU; j++) {
            int i = b * TG_NU + j;
            double *row = q->H + (size_t)i * TG_Q_W;
            row[i] += 2.0 * (s->move * (b < s->n_b - 1 ? 2.0 : 1.0) + s->drive * s->blocks[b]);
            if (b)
                row[i - TG_NU] -= 2.0 * s->move;
        }
}

/* Whether what was made for the program of the last solve is this one's. */
static int is_kept(const tg_controller *c)
{
    return c->design->linear && c->qp.kept && !memcmp(c->kept_lost, c->lost, sizeof c->lost);
}

static void set_soft_rows(tg_controller *c, const double *target, const double *side)
{
    const tg_design *s = c->design;
    tg_qp *q = &c->qp;
    int rows = s->n_c + s->n_l;
    for (int r = 0, apart = 0; r < rows; r++) {
        double *lower = q->lower + 2 * q->n + r, *upper = q->upper + 2 * q->n + r;
        const double *goal = NULL, *free = c->free + r;
        double low = -NONE, high = NONE;
        if (r >= s->n_c) {
            low = s->limit_low[r - s->n_c];
            high = s->limit_high[r - s->n_c];
        } else if (s->zone[r] > 0.0 ? !c->lost[r] : side[r] != 0.0) {
            goal = goals_of(c, target, r, &apart);
            if (s->zone[r] > 0.0 || side[r] < 0.0)
                low = s->zone[r] > 0.0 ? -s->zone[r] : -s->overshoot;
            if (s->zone[r] > 0.0 || side[r] > 0.0)
                high = s->zone[r] > 0.0 ? s->zone[r] : s->overshoot;
        }
        for (int k = 0; k < s->N; k++) {
            double at = (goal ? goal[k * apart] : 0.0) - free[k * rows];
            lower[k * rows] = low + at;
            upper[k * rows] = high + at;
        }
    }
}

#if TG_NO > 0
/* The outputs that count of a linear plant, without any plan, by state, disturbances and biases of drives. */
static void free_by_state(tg_controller *c, const double *x, const double *drive_bias, const double *d,
                          const double *bias)
{
    const tg_design *s = c->design;
    double z[TG_Q_W] = {0.0};
    int at = 0;
    for (int i = 0; i < s->n_b * TG_NU; i++)
        z[i] = drive_bias[i % TG_NU] / s->span[i % TG_NU];
    tg_soft_values(&c->qp, z, c->free);
    for (int k = 0; k < s->N; k++)
        for (int r = 0; r < s->n_c + s->n_l; r++, at++) {
            double sum = s->by_none[at] + bias[row_of(s, r)] + c->free[at];
            for (int j = 0; j < TG_NX; j++)
                sum += s->by_x[at * TG_NX + j] * x[j];
            for (int j = 0; j < TG_ND; j++)
                sum += s->by_d[at * TG_ND + j] * d[j];
            c->free[at] = sum;
        }
}
#else
/* The outputs that count, without any plan, by the gains under the guess, whose outputs are known. */
static void free_by_gains(tg_controller *c, const double *guess)
{
    const tg_design *s = c->design;
    double z[TG_Q_W] = {0.0};
    for (int i = 0; i < s->n_b * TG_NU; i++)
        z[i] = guess[i] / s->span[i % TG_NU];
    tg_soft_values(&c->qp, z, c->free);
    for (int r = 0, rows = s->n_c + s->n_l; r < rows; r++) {
        const double *y = c->y_guess + row_of(s, r);
        for (int k = 0; k < s->N; k++)
            c->free[k * rows + r] = y[k * TG_NY] - c->free[k * rows + r];
    }
}
#endif

/* The outputs that count of a linear plant under a plan. */
static void follow_gains(const tg_controller *c, const double *plan, double *y)
{
    const tg_design *s = c->design;
    double z[TG_Q_W] = {0.0};
    for (int i = 0; i < s->n_b * TG_NU; i++)
        z[i] = plan[i] / s->span[i % TG_NU];
    for (int k = 0, at = 0; k < s->N; k++)
        for (int r = 0; r < s->n_c + s->n_l; r++, at++)
            y[k * TG_NY + row_of(s, r)] = c->free[at] + tg_product(response(c, k, r), z, length(c, k));
}

/* Keep a plan where it is the best so far. */
static void consider(tg_controller *c, const double *x, const double *plan, const double *d,
                     const double *target, const double *side, const double *bias, const double *drive_bias,
                     const double *last, double *least)
{
    double cost;
    tg_simulate(c, x, plan, drive_bias, d, bias, c->y_try);
    cost = TG_BARELY * merit(c, plan, c->y_try, target, side, last);
    if (cost < *least) { /* a plan that is hardly better is not worth a jump */
        *least = cost;
        memcpy(c->best, plan, (size_t)c->qp.n * sizeof(double));
        memcpy(c->y_best, c->y_try, sizeof c->y_try);
    }
}

static void try_others(tg_controller *c, const double *x, const double *guess, const double *d,
                       const double *target, const double *side, const double *bias, const double *drive_bias,
                       const double *last, double least, int shorter, int ramps)
{
    static const double shares[4] = TG_SHARES;
    const tg_design *s = c->design;
    double full[TG_Q_N], plan[TG_Q_N];
    memcpy(full, c->best, sizeof full);
    for (int at = 0; shorter && at < 4; at++) {
        for (int i = 0; i < c->qp.n; i++)
            plan[i] = guess[i] + shares[at] * (full[i] - guess[i]);
        consider(c, x, plan, d, target, side, bias, drive_bias, last, &least);
    }
    for (int way = 0; ramps && way < 2; way++) { /* to none, and to the other end, which is not none */
        for (int b = 0; b < s->n_b; b++)
            for (int j = 0; j < TG_NU; j++) {
                int up = s->lowest[j] == s->neutral[j] || (last[j] <= s->neutral[j] && s->highest[j] > s->neutral[j]);
                double far = up ? s->highest[j] : s->lowest[j];
                double end = way ? far : s->neutral[j], room = (s->reach[b] + more_slew(c)) * s->slew[j];
                plan[b * TG_NU + j] = fmin(fmax(end, last[j] - room), last[j] + room);
            }
        park(c, last, plan);
        consider(c, x, plan, d, target, side, bias, drive_bias, last, &least);
    }
}

static void find_broken(tg_controller *c)
{
    const tg_design *s = c->design;
    c->broken = 0.0;
    for (int r = 0; r < s->n_l; r++)
        for (int k = 0; k < s->N; k++) {
            double value = c->y_best[k * TG_NY + s->limited[r]], unit = s->unit[s->limited[r]];
            double over = fmax(s->limit_low[r] - value, value - s->limit_high[r]);
            if (over / unit > c->broken / s->unit[c->breaks]) {
                c->broken = over;
                c->breaks = s->limited[r];
            }
        }
}

static void set_prices(const tg_design *s, tg_qp *q)
{
    double one = first(s);
    q->per = s->n_c + s->n_l;
    for (int r = 0; r < q->per; r++) {
        int zone = r < s->n_c && s->zone[r] > 0.0;
        q->price[r] = zone ? s->weight[r] * s->track : one * (r >= s->n_c ? s->dear[r - s->n_c] : s->price);
        q->ratio[r] = zone ? 2.0 : 2.0 / one;
        q->at_end[r] = zone ? s->weight[r] * (s->track + s->terminal) : q->price[r];
    }
}

int tg_optimise(tg_controller *c, const double *x, const double *last, const double *start, const double *d,
                const double *target, const double *from, const double *bias, const double *drive_bias)
{
    const tg_design *s = c->design;
    tg_qp *q = &c->qp;
    double at_guess, cost, guess[TG_Q_N], side[TG_NC];
    int uphill, look_around;
    q->n = s->n_b * TG_NU;
    q->stride = TG_NU;
    q->s = s->N * (s->n_c + s->n_l);
    set_prices(s, q);
    q->iteration_limit = s->iteration_limit;
    q->late = c->late;
    q->about = c->about;
    memcpy(guess, start, (size_t)q->n * sizeof(double));
    park(c, last, guess);
    for (int r = 0; r < s->n_c; r++)
        side[r] = c->lost[r] || c->goals || c->ramps ? 0.0 : from[r]; /* nothing is beyond a target that moves */
    if (!s->linear || !c->has_gains) {
        linearise(c, x, guess, drive_bias, d, bias);
        find_authority(c);
        c->has_gains = s->linear;
    }
#if TG_NO > 0
    free_by_state(c, x, drive_bias, d, bias);
#else
    free_by_gains(c, guess);
#endif
    q->kept = is_kept(c);
    if (!q->kept)
        set_quadratic_cost(c);
    memcpy(c->kept_lost, c->lost, sizeof c->lost);
    set_linear_cost(c, target, last);
    set_bounds(c, guess, drive_bias, last);
    set_soft_rows(c, target, side);
    c->qp_status = tg_qp_solve(q);
    c->iterations = q->iterations;
    c->broken = 0.0;
    if (c->qp_status != TG_QP_SOLVED)
        return c->qp_status;
    for (int i = 0; i < q->n; i++)
        c->best[i] = q->x[i] * s->span[i % TG_NU];
    park(c, last, c->best);
    if (s->linear) {
        follow_gains(c, c->best, c->y_best);
        find_broken(c);
        return c->qp_status;
    }
    at_guess = merit(c, guess, c->y_guess, target, side, last);
    tg_simulate(c, x, c->best, drive_bias, d, bias, c->y_best);
    cost = merit(c, c->best, c->y_best, target, side, last);
    c->solves++;
    uphill = cost > at_guess; /* perhaps by rounding alone, so it is no reason for ramps */
    look_around = c->solves % TG_LOOK_AROUND == 1;
    if (uphill || look_around)
        try_others(c, x, guess, d, target, side, bias, drive_bias, last, cost, uphill, look_around);
    find_broken(c);
    return c->qp_status;
}

/* A dual active-set method for a small convex QP with hard and soft rows.
 *
 * With H = LL' and m_i = L^-1 a_i the dual of the problem, for a set W of rows at their bounds with signs
 * s_i (+1 upper, -1 lower), is
 *
 *     maximise over lambda    - 1/2 lambda' K lambda + r' lambda,
 *     K_ij = s_i s_j m_i'm_j,     r_i = - s_i b_i - s_i m_i'c,     c = L^-1 f,
 *
 * with lambda >= 0.  A soft row with penalties w, q adds to it: up to lambda = w its bound holds; beyond, it is
 * broken by (lambda - w)/q, which adds 1/q to K_ii and w/q to r_i.  So the dual is concave, piecewise
 * quadratic, and a row is in one of four states: outside the set, hard, soft and kept, soft and broken.
 *
 * Start anywhere with lambda >= 0. Solve K lambda* = r (an LDL' factor of K, updated row by row); go toward
 * lambda* until the first multiplier reaches the end of its state, which then changes; repeat. Where all of
 * lambda* is reached, x = L'^-1 (-c - sum s_i m_i lambda_i) fulfils all rows in the set; take in the row that
 * is broken most, or be done.  Each move raises the dual, so that no set comes twice.  (D. Goldfarb, A. Idnani,
 * Mathematical Programming 27, 1983, is the method without soft rows.)
 *
 * Rows may depend on one another: a range and a sum of slews that ends on it.  Every K_ii therefore includes a
 * share of 1e-11 of itself, which keeps the factor regular and the dual strictly concave; multipliers that
 * contradict each other diverge until one reaches its bound. The effect of that share on x is removed at
 * the end by one step of refinement with K itself. Hard rows that cannot be fulfilled together show there.
 */
#include "tg_qp.h"

#include <math.h>
#include <string.h>

#define FAR 1e15
#define TOLERANCE 1e-10 /* of a row, in units of its own length */
#define REGULAR 1e-11   /* share of K_ii that keeps its factor regular */
#define CONTRADICTION 1e-6 /* by which a hard row may stay broken, in units of its length */
#define SHORT 1e-5      /* a soft row shorter than this cannot be kept by any plan */

static double *fit_row(tg_qp *q, int i) { return q->fit + (size_t)i * (size_t)(i + 1) / 2; }

void tg_qp_forget(tg_qp *q) { q->n_work = 0; }

static int all_finite(const double *a, int n)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(a[i]))
            return 0;
    return 1;
}

static int problem_is_finite(const tg_qp *q)
{
    for (int i = 0; i < q->n && !q->kept; i++)
        if (!all_finite(q->H + (size_t)i * TG_Q_N, i + 1))
            return 0;
    for (int i = 0; i < 2 * q->n + q->s; i++)
        if (isnan(q->lower[i]) || isnan(q->upper[i]))
            return 0;
    for (int i = 0; i < q->s && !q->kept; i++)
        if (!all_finite(q->A + (size_t)i * TG_Q_N, q->filled[i]))
            return 0;
    return all_finite(q->f, q->n);
}

/* How much each row weighs beside the others: 1 over its length, unknowns in units of H_jj^-1/2. */
static int weigh_rows(tg_qp *q)
{
    double size[TG_Q_N] = {0.0};
    int n = q->n;
    for (int j = 0; j < n; j++) {
        double diagonal = q->H[(size_t)j * (TG_Q_N + 1)];
        if (!(diagonal > 0.0))
            return 0;
        size[j] = 1.0 / sqrt(diagonal);
        q->weight[j] = 1.0 / size[j];
    }
    for (int j = 0; j < n; j++) {
        double before = j >= q->stride ? size[j - q->stride] : 0.0;
        q->weight[n + j] = 1.0 / sqrt(size[j] * size[j] + before * before);
    }
    for (int i = 0; i < q->s; i++) {
        const double *a = q->A + (size_t)i * TG_Q_N;
        double sum = 0.0;
        for (int j = 0; j < q->filled[i]; j++)
            sum += a[j] * a[j] * size[j] * size[j];
        q->weight[2 * n + i] = sum > SHORT * SHORT ? 1.0 / sqrt(sum) : 0.0;
    }
    return 1;
}

/* Replace the lower triangle of H by its Cholesky factor, its diagonal inverted. */
static int factorise(tg_qp *q)
{
    for (int i = 0; i < q->n; i++) {
        double *row = q->H + (size_t)i * TG_Q_N;
        double whole = row[i];
        for (int j = 0; j <= i; j++) {
            const double *other = q->H + (size_t)j * TG_Q_N;
            double sum = row[j];
            for (int k = 0; k < j; k++)
                sum -= row[k] * other[k];
            if (j < i)
                row[j] = sum * other[j];
            else if (!(sum > 1e-14 * whole))
                return 0;
            else
                row[i] = 1.0 / sqrt(sum);
        }
    }
    return 1;
}

/* Replace b by L^-1 b, where b is 0 before entry `from`. */
static void forward(const tg_qp *q, double *b, int from)
{
    for (int i = from; i < q->n; i++) {
        const double *row = q->H + (size_t)i * TG_Q_N;
        double sum = b[i];
        for (int k = from; k < i; k++)
            sum -= row[k] * b[k];
        b[i] = sum * row[i];
    }
}

/* Replace b by L'^-1 b. */
static void backward(const tg_qp *q, double *b)
{
    for (int i = q->n - 1; i >= 0; i--) {
        const double *row = q->H + (size_t)i * TG_Q_N;
        double value = b[i] * row[i];
        b[i] = value;
        for (int k = 0; k < i; k++)
            b[k] -= row[k] * value;
    }
}

static double value_of(const tg_qp *q, int row)
{
    int n = q->n;
    if (row < n)
        return q->x[row];
    if (row < 2 * n)
        return q->x[row - n] - (row - n >= q->stride ? q->x[row - n - q->stride] : 0.0);
    const double *a = q->A + (size_t)(row - 2 * n) * TG_Q_N;
    double sum = 0.0;
    for (int j = 0; j < q->filled[row - 2 * n]; j++)
        sum += a[j] * q->x[j];
    return sum;
}

static void make_normal(const tg_qp *q, int row, int side, double *m)
{
    int n = q->n, from = 0;
    memset(m, 0, (size_t)n * sizeof *m);
    if (row < n) {
        m[row] = side;
        from = row;
    } else if (row < 2 * n) {
        int j = row - n;
        m[j] = side;
        from = j;
        if (j >= q->stride) {
            m[j - q->stride] = -side;
            from = j - q->stride;
        }
    } else {
        const double *a = q->A + (size_t)(row - 2 * n) * TG_Q_N;
        for (int j = 0; j < q->filled[row - 2 * n]; j++)
            m[j] = side * a[j];
    }
    forward(q, m, from);
}

/* The price of breaking a soft row. */
static double price_of(const tg_qp *q, int row)
{
    int at = row - 2 * q->n;
    return at >= q->s - q->per ? q->at_end[at % q->per] : q->price[at % q->per];
}

/* By what its square is dearer. */
static double ratio_of(const tg_qp *q, int row) { return q->ratio[(row - 2 * q->n) % q->per]; }

/* Set the right side of a row in the set from its bound and its state. */
static void set_right(tg_qp *q, int i)
{
    const double *m = q->normal + (size_t)i * TG_Q_N;
    double bound = q->side[i] > 0 ? q->upper[q->row[i]] : -q->lower[q->row[i]];
    double sum = -bound;
    for (int j = 0; j < q->n; j++)
        sum -= m[j] * q->c[j];
    q->right[i] = sum + (q->state[i] == 2 ? 1.0 / ratio_of(q, q->row[i]) : 0.0);
}

/* Append the factor's row i, whose normal is in place. */
static void append_fit(tg_qp *q, int i)
{
    const double *m = q->normal + (size_t)i * TG_Q_N;
    double *row = fit_row(q, i);
    double left = 0.0;
    for (int j = 0; j < q->n; j++)
        left += m[j] * m[j];
    left += REGULAR * left + (q->state[i] == 2 ? 1.0 / (ratio_of(q, q->row[i]) * price_of(q, q->row[i])) : 0.0);
    for (int k = 0; k < i; k++) {
        const double *other = q->normal + (size_t)k * TG_Q_N;
        double sum = 0.0;
        for (int j = 0; j < q->n; j++)
            sum += m[j] * other[j];
        row[k] = sum;
    }
    for (int k = 0; k < i; k++) {
        const double *other = fit_row(q, k);
        double sum = row[k];
        for (int j = 0; j < k; j++)
            sum -= other[j] * row[j];
        row[k] = sum;
    }
    for (int k = 0; k < i; k++) {
        double scaled = row[k] / q->pivot[k];
        left -= scaled * row[k];
        row[k] = scaled;
    }
    row[i] = 1.0;
    q->pivot[i] = left;
}

/* Take row r out of the factor: the remainder is a rank-one change of the rows behind. */
static void remove_fit(tg_qp *q, int r)
{
    double spare[TG_Q_M] = {0.0};
    double weight = q->pivot[r];
    for (int i = r + 1; i < q->n_work; i++)
        spare[i] = fit_row(q, i)[r];
    for (int i = r + 1; i < q->n_work; i++) {
        const double *from = fit_row(q, i);
        double *into = fit_row(q, i - 1);
        for (int j = 0; j < r; j++)
            into[j] = from[j];
        for (int j = r + 1; j <= i; j++)
            into[j - 1] = from[j];
        q->pivot[i - 1] = q->pivot[i];
    }
    for (int i = r; i < q->n_work - 1; i++) { /* D + weight z z', column by column */
        double z = spare[i + 1], before = q->pivot[i], after = before + weight * z * z;
        double gain = weight * z / after;
        weight *= before / after;
        q->pivot[i] = after;
        for (int k = i + 1; k < q->n_work - 1; k++) {
            double *entry = fit_row(q, k) + i;
            spare[k + 1] -= z * *entry;
            *entry += gain * spare[k + 1];
        }
    }
}

static void move_entry(tg_qp *q, int from, int to)
{
    memmove(q->normal + (size_t)to * TG_Q_N, q->normal + (size_t)from * TG_Q_N, (size_t)q->n * sizeof(double));
    q->row[to] = q->row[from];
    q->side[to] = q->side[from];
    q->state[to] = q->state[from];
    q->multiplier[to] = q->multiplier[from];
    q->right[to] = q->right[from];
}

/* Take entry r out of the set. */
static void drop(tg_qp *q, int r)
{
    remove_fit(q, r);
    q->in_set[q->row[r]] = 0;
    for (int i = r; i < q->n_work - 1; i++)
        move_entry(q, i + 1, i);
    q->n_work--;
}

static double least(const tg_qp *q, int i) { return q->state[i] == 2 ? price_of(q, q->row[i]) : 0.0; }
static double most(const tg_qp *q, int i) { return q->state[i] == 1 ? price_of(q, q->row[i]) : HUGE_VAL; }

/* Take a row into the set. */
static void put(tg_qp *q, int row, int side, int state, double multiplier)
{
    int i = q->n_work++;
    make_normal(q, row, side, q->normal + (size_t)i * TG_Q_N);
    q->row[i] = row;
    q->side[i] = (signed char)side;
    q->state[i] = (signed char)state;
    q->multiplier[i] = multiplier;
    q->in_set[row] = 1;
    set_right(q, i);
    append_fit(q, i);
}

/* Entry r has reached the bound of its state: it leaves the set, or becomes broken, or kept. */
static void change(tg_qp *q, int r, int upward)
{
    int row = q->row[r], side = q->side[r], state = q->state[r];
    drop(q, r);
    if (state == 1 && upward)
        put(q, row, side, 2, price_of(q, row));
    if (state == 2)
        put(q, row, side, 1, price_of(q, row));
}

/* Replace b by the solution of K z = b, by the factor. */
static void solve_fit(const tg_qp *q, double *b)
{
    tg_qp *open = (tg_qp *)q; /* fit_row reads only */
    for (int i = 0; i < q->n_work; i++) {
        const double *row = fit_row(open, i);
        double sum = b[i];
        for (int j = 0; j < i; j++)
            sum -= row[j] * b[j];
        b[i] = sum;
    }
    for (int i = q->n_work - 1; i >= 0; i--)
        b[i] /= q->pivot[i];
    for (int i = q->n_work - 1; i >= 0; i--) {
        const double *row = fit_row(open, i);
        for (int j = 0; j < i; j++)
            b[j] -= row[j] * b[i];
    }
}

static void make_x(tg_qp *q)
{
    for (int j = 0; j < q->n; j++)
        q->x[j] = -q->c[j];
    for (int i = 0; i < q->n_work; i++) {
        const double *m = q->normal + (size_t)i * TG_Q_N;
        for (int j = 0; j < q->n; j++)
            q->x[j] -= m[j] * q->multiplier[i];
    }
    backward(q, q->x);
}

/* Go toward the multipliers that fulfil the set; return -1 where they are reached, else who ended first. */
static int go(tg_qp *q, int *upward)
{
    int which = -1;
    double share = 1.0, scale = 0.0;
    memcpy(q->wanted, q->right, (size_t)q->n_work * sizeof(double));
    solve_fit(q, q->wanted);
    for (int i = 0; i < q->n_work; i++)
        scale = fmax(scale, fabs(q->wanted[i]));
    for (int i = 0; i < q->n_work; i++) {
        double low = least(q, i), high = most(q, i), slack = 1e-13 * scale;
        double there = q->wanted[i], here = q->multiplier[i], part = 1.0;
        if (there < low - slack)
            part = here > low ? (here - low) / (here - there) : 0.0;
        else if (there > high + slack)
            part = here < high ? (high - here) / (there - here) : 0.0;
        else
            continue;
        if (which < 0 || part < share) {
            share = part;
            which = i;
            *upward = there > high;
        }
    }
    for (int i = 0; i < q->n_work; i++)
        q->multiplier[i] += share * (q->wanted[i] - q->multiplier[i]);
    return which;
}

/* Find the row that is broken most; 0 where none is. */
static int worst(const tg_qp *q, int *row, int *side)
{
    double most_broken = TOLERANCE;
    int found = 0;
    for (int i = 0; i < 2 * q->n + q->s; i++) {
        double value, over, under;
        if (q->in_set[i] || q->weight[i] == 0.0 || (q->upper[i] > FAR && q->lower[i] < -FAR))
            continue;
        value = value_of(q, i);
        over = q->upper[i] > FAR ? 0.0 : (value - q->upper[i]) * q->weight[i];
        under = q->lower[i] < -FAR ? 0.0 : (q->lower[i] - value) * q->weight[i];
        if (over > most_broken || under > most_broken) {
            *row = i;
            *side = over > under ? 1 : -1;
            most_broken = over > under ? over : under;
            found = 1;
        }
    }
    return found;
}

/* Take the last solve's set in again, where its bounds still exist. same: its normals and its factor hold. */
static void take_up(tg_qp *q, int same)
{
    int kept = q->n_work;
    for (int i = 0; same && i < kept; i++)
        same = (q->side[i] > 0 ? q->upper[q->row[i]] : -q->lower[q->row[i]]) <= FAR;
    for (int i = 0; same && i < kept; i++) {
        q->in_set[q->row[i]] = 1;
        set_right(q, i);
    }
    if (same)
        return;
    q->n_work = 0;
    for (int i = 0; i < kept; i++) {
        int row = q->row[i], side = q->side[i], state = q->state[i];
        double multiplier = q->multiplier[i], bound;
        if (row >= 2 * q->n + q->s || q->weight[row] == 0.0)
            continue;
        bound = side > 0 ? q->upper[row] : -q->lower[row];
        if (bound > FAR)
            continue;
        put(q, row, side, state, multiplier);
    }
}

/* Fulfil the rows of the set as K itself requires; return whether the hard ones are. */
static int refine(tg_qp *q)
{
    for (int i = 0; i < q->n_work; i++) {
        double value = q->side[i] * value_of(q, q->row[i]);
        double bound = q->side[i] > 0 ? q->upper[q->row[i]] : -q->lower[q->row[i]];
        q->wanted[i] = value - bound; /* of a kept row it is 0, of a broken one what its multiplier pays */
        if (q->state[i] == 2)
            q->wanted[i] -= (q->multiplier[i] / price_of(q, q->row[i]) - 1.0) / ratio_of(q, q->row[i]);
    }
    solve_fit(q, q->wanted);
    for (int i = 0; i < q->n_work; i++)
        q->multiplier[i] += q->wanted[i];
    make_x(q);
    for (int i = 0; i < q->n_work; i++) {
        double bound = q->side[i] > 0 ? q->upper[q->row[i]] : -q->lower[q->row[i]];
        double over = q->side[i] * value_of(q, q->row[i]) - bound;
        if (q->state[i] == 0 && !(over * q->weight[q->row[i]] < CONTRADICTION))
            return 0;
    }
    return 1;
}

static int failed(tg_qp *q, int status)
{
    tg_qp_forget(q);
    return status;
}

int tg_qp_solve(tg_qp *q)
{
    int row = 0, side = 0, upward = 0, which;
    int same = q->kept && !q->iterations; /* a factor that was updated is made anew, or its errors would add up */
    q->iterations = 0;
    if (!problem_is_finite(q))
        return failed(q, TG_QP_NOT_FINITE);
    for (int i = 0; i < 2 * q->n; i++)
        if (q->lower[i] > q->upper[i])
            return failed(q, TG_QP_INFEASIBLE);
    if (!q->kept && (!weigh_rows(q) || !factorise(q)))
        return failed(q, TG_QP_NOT_CONVEX);
    q->kept = 1;
    memcpy(q->c, q->f, (size_t)q->n * sizeof(double));
    forward(q, q->c, 0);
    memset(q->in_set, 0, sizeof q->in_set);
    take_up(q, same);
    while (q->iterations <= q->iteration_limit) {
        if (q->late && q->late(q->about))
            return failed(q, TG_QP_TIME);
        which = go(q, &upward);
        if (which >= 0) {
            q->iterations++;
            change(q, which, upward);
            continue;
        }
        make_x(q);
        if (!worst(q, &row, &side)) {
            if (!refine(q))
                return failed(q, TG_QP_INFEASIBLE);
            return all_finite(q->x, q->n) ? TG_QP_SOLVED : failed(q, TG_QP_NOT_FINITE);
        }
        q->iterations++;
        put(q, row, side, row >= 2 * q->n ? 1 : 0, 0.0);
    }
    return failed(q, TG_QP_ITERATIONS);
}

// ProxDDP of aligator on a stage-wise problem whose functions are C code by CasADi; see controller_peers.py.
// Called with the tolerance and the first penalty. Reads sizes, bounds and the parameters of all steps; writes for each step its seconds of the processor, its cost
// and its iterations.
#include <aligator/core/cost-abstract.hpp>
#include <aligator/core/explicit-dynamics.hpp>
#include <aligator/core/stage-model.hpp>
#include <aligator/core/traj-opt-problem.hpp>
#include <aligator/core/vector-space.hpp>
#include <aligator/modelling/constraints/box-constraint.hpp>
#include <aligator/modelling/state-error.hpp>
#include <aligator/solvers/proxddp/solver-proxddp.hpp>

#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>

using namespace aligator;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Ref = Eigen::Ref<const VectorXd>;
using Space = VectorSpaceTpl<double>;

extern "C" {
typedef int Evaluate(const double **, double **, long long *, double *, int);
typedef int Work(long long *, long long *, long long *, long long *);
Evaluate stage_value, stage_all, end_all;
Work stage_value_work, stage_all_work, end_all_work;
}

static int nx, nu, np, intervals, steps;
static VectorXd parameters;

struct Function {
  Evaluate *evaluate;
  std::vector<const double *> arg;
  std::vector<double *> res;
  std::vector<long long> iw;
  std::vector<double> w;

  Function(Evaluate *function, Work *work) : evaluate(function) {
    long long args, results, integers, reals;
    work(&args, &results, &integers, &reals);
    arg.resize(args + 1), res.resize(results + 1), iw.resize(integers + 1), w.resize(reals + 1);
  }
  void operator()(std::initializer_list<const double *> in, std::initializer_list<double *> out) {
    std::copy(in.begin(), in.end(), arg.begin());
    std::copy(out.begin(), out.end(), res.begin());
    evaluate(arg.data(), res.data(), iw.data(), w.data(), 0);
  }
};

// All values and derivatives of a stage at its last point, which cost and dynamics share.
struct Stage {
  Function value{stage_value, stage_value_work}, all{stage_all, stage_all_work};
  double cost;
  VectorXd gradient{nx + nu}, next{nx}, x{nx}, u{nu};
  MatrixXd hessian{nx + nu, nx + nu}, jacobian{nx, nx + nu};
  bool has_value = false, has_all = false;

  void at(const Ref &px, const Ref &pu, bool derivatives) {
    if (x != px || u != pu) x = px, u = pu, has_value = has_all = false;
    if (derivatives && !has_all) {
      all({x.data(), u.data(), parameters.data()},
          {&cost, gradient.data(), hessian.data(), next.data(), jacobian.data()});
      has_all = has_value = true;
    } else if (!has_value) {
      value({x.data(), u.data(), parameters.data()}, {&cost, next.data()});
      has_value = true;
    }
  }
};

struct Dynamics : ExplicitDynamicsModelTpl<double> {
  std::shared_ptr<Stage> stage;
  Dynamics(std::shared_ptr<Stage> shared) : ExplicitDynamicsModelTpl<double>(Space(::nx), ::nu), stage(shared) {}
  void forward(const ConstVectorRef &x, const ConstVectorRef &u, Data &data) const override {
    stage->at(x, u, false);
    data.xnext_ = stage->next;
  }
  void dForward(const ConstVectorRef &x, const ConstVectorRef &u, Data &data) const override {
    stage->at(x, u, true);
    data.jac_buffer_ = stage->jacobian;
  }
};

struct Cost : CostAbstractTpl<double> {
  std::shared_ptr<Stage> stage;
  Cost(std::shared_ptr<Stage> shared) : CostAbstractTpl<double>(Space(::nx), ::nu), stage(shared) {}
  void evaluate(const ConstVectorRef &x, const ConstVectorRef &u, CostData &data) const override {
    stage->at(x, u, false);
    data.value_ = stage->cost;
  }
  void computeGradients(const ConstVectorRef &x, const ConstVectorRef &u, CostData &data) const override {
    stage->at(x, u, true);
    data.grad_ = stage->gradient;
  }
  void computeHessians(const ConstVectorRef &x, const ConstVectorRef &u, CostData &data) const override {
    stage->at(x, u, true);
    data.hess_ = stage->hessian;
  }
};

struct End : CostAbstractTpl<double> {
  mutable Function all{end_all, end_all_work};
  End() : CostAbstractTpl<double>(Space(::nx), ::nu) {}
  void run(const ConstVectorRef &x, CostData &data) const {
    VectorXd at = x, gradient(::nx);
    MatrixXd hessian(::nx, ::nx);
    all({at.data(), parameters.data()}, {&data.value_, gradient.data(), hessian.data()});
    data.Lx_ = gradient, data.Lxx_ = hessian;
  }
  void evaluate(const ConstVectorRef &x, const ConstVectorRef &, CostData &data) const override { run(x, data); }
  void computeGradients(const ConstVectorRef &x, const ConstVectorRef &, CostData &d) const override { run(x, d); }
  void computeHessians(const ConstVectorRef &x, const ConstVectorRef &, CostData &d) const override { run(x, d); }
};

static VectorXd read(int count) {
  VectorXd values(count);
  for (int i = 0; i < count; ++i)
    if (std::scanf("%lf", &values[i]) != 1) std::exit(2);
  return values;
}

static double processor_time() {
  timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}

int main(int, char **words) {
  if (std::scanf("%d %d %d %d %d", &nx, &nu, &np, &intervals, &steps) != 5) return 2;
  VectorXd lower = read(nx + nu), upper = read(nx + nu);
  std::vector<VectorXd> data;
  for (int k = 0; k < steps; ++k) data.push_back(read(np));
  parameters = data[0];

  std::vector<xyz::polymorphic<StageModelTpl<double>>> stages;
  const StateErrorResidualTpl<double> states(Space(::nx), nu, VectorXd::Zero(nx));
  const ControlErrorResidualTpl<double> controls(nx, Space(nu), VectorXd::Zero(nu));
  const BoxConstraintTpl<double> box_x(lower.head(nx), upper.head(nx)), box_u(lower.tail(nu), upper.tail(nu));
  for (int k = 0; k < intervals; ++k) {
    auto shared = std::make_shared<Stage>();
    StageModelTpl<double> stage{Cost(shared), Dynamics(shared)};
    stage.addConstraint(controls, box_u);
    if (k) stage.addConstraint(states, box_x);
    stages.push_back(stage);
  }
  TrajOptProblemTpl<double> problem(data[0].head(nx), stages, End());
  problem.addTerminalConstraint(states, box_x);

  std::vector<VectorXd> xs(intervals + 1, data[0].head(nx)), us(intervals, VectorXd::Zero(nu)), vs, lams;
  SolverProxDDPTpl<double> solver(std::atof(words[1]), std::atof(words[2]), 200);
  solver.rollout_type_ = RolloutType::LINEAR;
  solver.setup(problem);
  for (int k = 0; k < steps; ++k) {
    parameters = data[k];
    problem.setInitState(parameters.head(nx));
    xs[0] = parameters.head(nx);
    const double began = processor_time();
    // functions keep their last point, whose values change with the parameters
    for (auto &stage : problem.stages_) static_cast<const Cost &>(*stage->cost_).stage->x.setConstant(NAN);
    solver.run(problem, xs, us, vs, lams);
    const double seconds = processor_time() - began;
    xs = solver.results_.xs, us = solver.results_.us, vs = solver.results_.vs, lams = solver.results_.lams;
    std::printf("%.17g %.17g %zu\n", seconds, solver.results_.traj_cost_, solver.results_.num_iters);
  }
}

// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

// Simulates the model `dlo` of an SDF world with the physics of Gazebo (gz-physics, DART), steps of 1 ms.
//
//     gazebo WORLD.sdf SECONDS EVERY DRAG STIFFNESS DAMPING < HANDS
//
// Each line of HANDS is a gripped point: link, place along it [m], number of knots, and for each knot
// t x y z.  From the first knot to the last, a spring [N/m] with a damper [N s/m] pulls the point to the hand.
// DRAG [1/s] slows each link.  Every EVERY seconds a line is printed: time, and of each link x y z qw qx qy qz.

#include <cmath>
#include <cstdlib>
#include <iomanip>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

#include <ignition/physics/ForwardStep.hh>
#include <ignition/physics/FrameSemantics.hh>
#include <ignition/physics/GetEntities.hh>
#include <ignition/physics/Link.hh>
#include <ignition/physics/RequestEngine.hh>
#include <ignition/physics/sdf/ConstructCollision.hh>
#include <ignition/physics/sdf/ConstructJoint.hh>
#include <ignition/physics/sdf/ConstructLink.hh>
#include <ignition/physics/sdf/ConstructModel.hh>
#include <ignition/physics/sdf/ConstructWorld.hh>
#include <ignition/plugin/Loader.hh>
#include <sdf/sdf.hh>

namespace physics = ignition::physics;

struct Features : physics::FeatureList<
  physics::ForwardStep, physics::GetEntities, physics::LinkFrameSemantics, physics::AddLinkExternalForceTorque,
  physics::sdf::ConstructSdfWorld, physics::sdf::ConstructSdfModel, physics::sdf::ConstructSdfLink,
  physics::sdf::ConstructSdfJoint, physics::sdf::ConstructSdfCollision> {};

struct Hand {
  std::size_t link;
  double place;
  std::vector<double> times;
  std::vector<Eigen::Vector3d> points;
};

const double STEP = 0.001;

int main(int, char **words)
{
  sdf::Root root;
  const auto errors = root.Load(words[1]);
  for (const auto &error : errors)
    std::cerr << error << "\n";
  if (!errors.empty())
    return 1;
  const double seconds = std::atof(words[2]), every = std::atof(words[3]), drag = std::atof(words[4]);
  const double stiffness = std::atof(words[5]), damping = std::atof(words[6]);

  std::vector<Hand> hands;
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream in(line);
    Hand hand;
    std::size_t knots = 0;
    in >> hand.link >> hand.place >> knots;
    for (std::size_t k = 0; k < knots; ++k) {
      double t, x, y, z;
      in >> t >> x >> y >> z;
      hand.times.push_back(t);
      hand.points.emplace_back(x, y, z);
    }
    hands.push_back(hand);
  }

  ignition::plugin::Loader loader;
  loader.LoadLib(DARTSIM);
  auto engine = physics::RequestEngine3d<Features>::From(loader.Instantiate("ignition::physics::dartsim::Plugin"));
  auto world = engine->ConstructWorld(*root.WorldByIndex(0));
  const auto described = root.WorldByIndex(0)->ModelByName("dlo");
  auto model = world->GetModel("dlo");
  std::vector<decltype(model->GetLink(std::size_t(0)))> links;
  std::vector<double> masses;
  for (std::size_t k = 0; k < described->LinkCount(); ++k) {
    links.push_back(model->GetLink(described->LinkByIndex(k)->Name()));
    masses.push_back(described->LinkByIndex(k)->Inertial().MassMatrix().Mass());
  }
  physics::ForwardStep::Input input;
  physics::ForwardStep::State state;
  physics::ForwardStep::Output output;
  std::cout << std::setprecision(9);
  const long steps = std::lround(seconds / STEP), between = std::max(1L, std::lround(every / STEP));
  for (long k = 0; k <= steps; ++k) {
    std::vector<Eigen::Isometry3d> poses;
    std::vector<Eigen::Vector3d> velocities, spins;
    for (auto &link : links) {
      const auto frame = link->FrameDataRelativeToWorld();
      poses.push_back(frame.pose);
      velocities.push_back(frame.linearVelocity);
      spins.push_back(frame.angularVelocity);
    }
    if (k % between == 0 || k == steps) {
      std::cout << k * STEP;
      for (const auto &pose : poses) {
        const Eigen::Quaterniond turn(pose.linear());
        const auto &x = pose.translation();
        std::cout << " " << x.x() << " " << x.y() << " " << x.z() << " " << turn.w() << " " << turn.x() << " "
                  << turn.y() << " " << turn.z();
      }
      std::cout << "\n";
    }
    for (std::size_t i = 0; i < links.size(); ++i)
      links[i]->AddExternalForce(Eigen::Vector3d(-drag * masses[i] * velocities[i]));
    for (const auto &hand : hands) {
      const double t = k * STEP;
      if (t < hand.times.front() || t >= hand.times.back())
        continue;
      std::size_t knot = 1;
      while (hand.times[knot] < t)
        ++knot;
      const double span = hand.times[knot] - hand.times[knot - 1];
      const Eigen::Vector3d path = hand.points[knot] - hand.points[knot - 1];
      const Eigen::Vector3d target = hand.points[knot - 1] + path * ((t - hand.times[knot - 1]) / span);
      const auto &pose = poses[hand.link];
      const Eigen::Vector3d local(hand.place, 0, 0);
      const Eigen::Vector3d velocity = velocities[hand.link] + spins[hand.link].cross(pose.linear() * local);
      const Eigen::Vector3d force = stiffness * (target - pose * local) + damping * (path / span - velocity);
      links[hand.link]->AddExternalForce(force, physics::FrameID::World(), local);
    }
    if (k < steps)
      world->Step(output, state, input);
  }
}

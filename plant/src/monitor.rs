//! What is watched during a run: feet, pressure points, slip, falls, energy.
//!
//! | quantity | definition |
//! |---|---|
//! | wrench of a foot over a step | `f = Σ λ_i/Δt`, `τ = Σ_α w_α Σ_i x_i(q^α)×λ_i/Δt`: the exact balance of momentum |
//! | pressure point | `(-τ_y, τ_x)/f_z` about the sole frame's origin, in the sole plane; none below 1 % of the weight |
//! | friction use | `\|f_t\|/(μ f_n)` of the foot; use of single corners means nothing on a rigid sole |
//! | torsion use | `\|τ_n\|` about the pressure point over `μ Σ λ_n,i r_i/Δt` |
//! | slip | path of the contact patch's centre: mean over contacts with more than 1 % of the foot's load, `\|v_t\| > 1e-6 m/s` only |
//! | energy balance | `ΔE - (work of torques, pushes and contacts - joint damping)`, summed; what is left is the integrator's error |

use delmpc_mechanics::load_response::BoundaryMotion;
use delmpc_mechanics::spatial::{RigidTransform, Wrench};
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::Vector3;

use crate::contact_step::{ContactPoint, ContactResult, ContactStep};
use crate::error::{PlantError, require};
use crate::terrain::Terrain;

/// Slip below this speed is round-off and creep, m/s.
const SLIP_SPEED: f64 = 1e-6;
/// A contact counts for the patch's centre above this share of the foot's load.
const PATCH_SHARE: f64 = 0.01;
/// The pressure point is told above this share of the weight.
const PRESSURE_SHARE: f64 = 0.01;

/// A foot: contacts on one body under a flat sole.
#[derive(Clone, Debug, PartialEq)]
pub struct Foot {
    /// Body index.
    pub body: usize,
    /// Sole frame in the body's link frame: z up out of the sole plane, x forward.
    pub sole: RigidTransform,
    /// Indices of its contact points.
    pub contacts: Vec<usize>,
    /// Corners of the sole in the sole plane (x, y), counter-clockwise from above, m.
    pub polygon: Vec<[f64; 2]>,
}

/// What is known of a foot after a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FootReport {
    /// Wrench of the ground on the foot in the sole frame about its origin.
    pub wrench: Wrench,
    /// Whether any of its contacts carries load.
    pub touching: bool,
    /// Pressure point in the sole plane, m.
    pub pressure_point: Option<[f64; 2]>,
    /// Distance of the pressure point from the sole's edge, m; negative outside.
    pub pressure_margin: Option<f64>,
    /// Share of the friction limit that is used, 0 without load.
    pub friction_use: f64,
    /// Share of the torsion limit that is used, 0 without load.
    pub torsion_use: f64,
    /// Speed of the contact patch along the ground, m/s.
    pub slip_speed: f64,
    /// Path of slip since the last touch-down, m.
    pub slip: f64,
    /// Angle between sole and ground, rad; of ground that gives, between the sole and where the ground has given way to.
    pub tilt: f64,
    /// When it touched down last, s; `None` while in the air.
    pub touch_down: Option<f64>,
    /// Touch-downs so far (a foot that stands at the start has one).
    pub touch_downs: u32,
}

impl Default for FootReport {
    fn default() -> Self {
        Self {
            wrench: Wrench::default(),
            touching: false,
            pressure_point: None,
            pressure_margin: None,
            friction_use: 0.0,
            torsion_use: 0.0,
            slip_speed: 0.0,
            slip: 0.0,
            tilt: 0.0,
            touch_down: None,
            touch_downs: 0,
        }
    }
}

/// Why the robot counts as fallen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FallCause {
    /// The mass centre came too far down.
    MassCentreHeight,
    /// The base leans too far from how it leaned at the start.
    BaseTilt,
    /// This body, which is no foot, touched the ground.
    BodyContact {
        /// The body.
        body: usize,
    },
    /// The integrator found no step from here on.
    NoStep,
    /// A state that is no number.
    NotFinite,
}

/// When the robot counts as fallen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MonitorConfig {
    /// The foot on which the robot stands.
    pub stance_foot: usize,
    /// Least height of the mass centre above the stance foot, as a part of that at the start.
    pub min_com_height_share: f64,
    /// Largest angle between the vertical and where in the base it was at the start, rad.
    pub max_base_tilt: f64,
    /// Whether load on a contact that belongs to no foot is a fall.
    pub body_contact_is_fall: bool,
}

impl Default for MonitorConfig {
    fn default() -> Self {
        Self { stance_foot: 0, min_com_height_share: 0.5, max_base_tilt: 1.0, body_contact_is_fall: true }
    }
}

/// Everything a summary needs, over the run so far.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Totals {
    /// When and why the robot fell.
    pub fall: Option<(f64, FallCause)>,
    /// Least height of the whole mass centre above z = 0, m.
    pub min_com_height: f64,
    /// Largest slip path of the stance foot, m.
    pub max_stance_slip: f64,
    /// Largest tilt of the stance foot while it stood, rad.
    pub max_stance_tilt: f64,
    /// Least margin of the stance foot's pressure point, m; infinite while it never had one.
    pub min_pressure_margin: f64,
    /// Largest friction use of the stance foot.
    pub max_friction_use: f64,
    /// Largest torsion use of the stance foot.
    pub max_torsion_use: f64,
    /// Deepest penetration of a contact, m.
    pub max_penetration: f64,
    /// Steps in which rounds or law did not converge (the last iterate was kept).
    pub unconverged_steps: u64,
    /// Work of the joint torques, J.
    pub torque_work: f64,
    /// Work of the joint stops, J.
    pub stop_work: f64,
    /// Work of the pushes, J.
    pub push_work: f64,
    /// Work of the contacts (negative: friction and impacts), J.
    pub contact_work: f64,
    /// Energy lost in joint damping, J.
    pub damping_loss: f64,
    /// Energy (kinetic, weight, springs) now and at the start, J.
    pub energy: f64,
    /// At the start, J.
    pub start_energy: f64,
    /// Energy moved, `Σ |work|`, J.
    pub energy_moved: f64,
    /// Largest gain of energy in one step beyond the work done, J.
    pub max_energy_gain: f64,
}

impl Totals {
    /// Change of the energy that no work explains, J.
    pub fn energy_balance_error(&self) -> f64 {
        let work = self.torque_work + self.stop_work + self.push_work + self.contact_work - self.damping_loss;
        self.energy - self.start_energy - work
    }
}

/// Work of one step, J.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepWork {
    /// Of the joint torques.
    pub torque: f64,
    /// Of the joint stops.
    pub stop: f64,
    /// Of the pushes.
    pub push: f64,
    /// Of the contact forces.
    pub contact: f64,
    /// Lost in joint damping.
    pub damping: f64,
}

/// Watches a run.
#[derive(Clone, Debug)]
pub struct Monitor {
    config: MonitorConfig,
    feet: Vec<Foot>,
    reports: Vec<FootReport>,
    /// Whether a contact belongs to a foot.
    on_foot: Vec<bool>,
    weight: f64,
    /// Height of the mass centre above the ground's plane at the start, and the vertical in the base's axes.
    start_height: f64,
    start_up_b: Vector3<f64>,
    totals: Totals,
}

impl Monitor {
    /// For a robot with these feet and contacts.
    ///
    /// # Errors
    /// [`PlantError`] for feet that name no body or contact, or a stance foot that does not exist.
    pub fn new(
        tree: &KinematicTree,
        contacts: &[ContactPoint],
        feet: &[Foot],
        config: MonitorConfig,
    ) -> Result<Self, PlantError> {
        let shape = |quantity, got, expected| PlantError::Shape { quantity, got, expected };
        if !feet.is_empty() && config.stance_foot >= feet.len() {
            return Err(shape("stance foot", config.stance_foot, feet.len()));
        }
        require(config.max_base_tilt > 0.0, "largest base tilt", config.max_base_tilt, "positive")?;
        let mut on_foot = vec![false; contacts.len()];
        for foot in feet {
            if foot.body >= tree.body_count() {
                return Err(shape("body of a foot", foot.body, tree.body_count()));
            }
            for &contact in &foot.contacts {
                *on_foot.get_mut(contact).ok_or(shape("contact of a foot", contact, contacts.len()))? = true;
            }
        }
        if feet.len() > 32 {
            return Err(shape("feet", feet.len(), 32));
        }
        Ok(Self {
            config,
            feet: feet.to_vec(),
            reports: vec![FootReport::default(); feet.len()],
            on_foot,
            weight: tree.total_mass() * tree.gravity_w().norm(),
            start_height: 0.0,
            start_up_b: Vector3::z(),
            totals: Totals {
                fall: None,
                min_com_height: f64::INFINITY,
                max_stance_slip: 0.0,
                max_stance_tilt: 0.0,
                min_pressure_margin: f64::INFINITY,
                max_friction_use: 0.0,
                max_torsion_use: 0.0,
                max_penetration: 0.0,
                unconverged_steps: 0,
                torque_work: 0.0,
                stop_work: 0.0,
                push_work: 0.0,
                contact_work: 0.0,
                damping_loss: 0.0,
                energy: 0.0,
                start_energy: 0.0,
                energy_moved: 0.0,
                max_energy_gain: 0.0,
            },
        })
    }

    /// The feet.
    pub fn feet(&self) -> &[Foot] {
        &self.feet
    }

    /// What is known of every foot.
    pub fn reports(&self) -> &[FootReport] {
        &self.reports
    }

    /// The run so far.
    pub fn totals(&self) -> &Totals {
        &self.totals
    }

    /// Index of the stance foot.
    pub fn stance_foot(&self) -> usize {
        self.config.stance_foot
    }

    /// Bit i: foot i touches.
    pub fn contact_flags(&self) -> u32 {
        self.reports.iter().enumerate().map(|(i, report)| u32::from(report.touching) << i).sum()
    }

    pub(crate) fn set_start_energy(&mut self, energy: f64) {
        self.totals.energy = energy;
        self.totals.start_energy = energy;
    }

    /// From which posture a fall is judged.
    pub(crate) fn set_start(&mut self, tree: &KinematicTree, motion: &BoundaryMotion) {
        self.start_height = self.height(tree, motion);
        self.start_up_b = motion.kinematics().mass_centre_pose_w(0).rotation.row(2).transpose();
    }

    /// Height of the mass centre above the lowest contact point of a foot, m.
    fn height(&self, tree: &KinematicTree, motion: &BoundaryMotion) -> f64 {
        let kinematics = motion.kinematics();
        let feet = self.feet.iter().map(|foot| {
            let pose = kinematics.link_poses_w()[foot.body] * foot.sole;
            pose.translation.z
        });
        let lowest = feet.fold(f64::INFINITY, f64::min);
        let com = kinematics.mass_centre_of_tree_w(tree).z;
        if lowest.is_finite() { com - lowest } else { com }
    }

    pub(crate) fn count_failure(&mut self, time: f64) {
        self.totals.unconverged_steps += 1;
        self.totals.fall.get_or_insert((time, FallCause::NoStep));
    }

    /// Takes in one step that ended at `time`.
    pub(crate) fn update(
        &mut self,
        tree: &KinematicTree,
        step: &ContactStep,
        time: f64,
        converged: bool,
        energy: f64,
        work: &StepWork,
    ) {
        let motion = step.end_motion();
        for (index, (foot, report)) in self.feet.iter().zip(&mut self.reports).enumerate() {
            update_foot(foot, report, step, motion, self.weight, time);
            if index == self.config.stance_foot {
                let totals = &mut self.totals;
                totals.max_stance_slip = totals.max_stance_slip.max(report.slip);
                if report.touching {
                    totals.max_stance_tilt = totals.max_stance_tilt.max(report.tilt);
                }
                totals.max_friction_use = totals.max_friction_use.max(report.friction_use);
                totals.max_torsion_use = totals.max_torsion_use.max(report.torsion_use);
                if let Some(margin) = report.pressure_margin {
                    totals.min_pressure_margin = totals.min_pressure_margin.min(margin);
                }
            }
        }
        self.update_totals(tree, step, motion, time, converged);
        self.update_energy(energy, work);
    }

    fn update_totals(
        &mut self,
        tree: &KinematicTree,
        step: &ContactStep,
        motion: &BoundaryMotion,
        time: f64,
        converged: bool,
    ) {
        let height = self.height(tree, motion);
        let totals = &mut self.totals;
        totals.unconverged_steps += u64::from(!converged);
        let com = motion.kinematics().mass_centre_of_tree_w(tree);
        totals.min_com_height = totals.min_com_height.min(com.z);
        for result in step.results().iter().filter(|result| result.candidate) {
            totals.max_penetration = totals.max_penetration.max(-result.gap);
        }
        if totals.fall.is_some() {
            return;
        }
        let base = motion.kinematics().mass_centre_pose_w(0);
        let tilt = base.rotation.row(2).transpose().dot(&self.start_up_b);
        let body_contact = step.results().iter().zip(&self.on_foot).zip(step.contacts());
        let mut body_contact = body_contact.filter(|((result, on_foot), _)| result.touching && !**on_foot);
        let cause = if !com.iter().all(|x| x.is_finite()) {
            Some(FallCause::NotFinite)
        } else if height < self.config.min_com_height_share * self.start_height {
            Some(FallCause::MassCentreHeight)
        } else if tilt < self.config.max_base_tilt.cos() {
            Some(FallCause::BaseTilt)
        } else if self.config.body_contact_is_fall {
            body_contact.next().map(|(_, contact)| FallCause::BodyContact { body: contact.body })
        } else {
            None
        };
        totals.fall = cause.map(|cause| (time, cause));
    }

    fn update_energy(&mut self, energy: f64, work: &StepWork) {
        let totals = &mut self.totals;
        let done = work.torque + work.stop + work.push - work.damping;
        totals.max_energy_gain = totals.max_energy_gain.max(energy - totals.energy - done);
        totals.energy = energy;
        totals.torque_work += work.torque;
        totals.stop_work += work.stop;
        totals.push_work += work.push;
        totals.contact_work += work.contact;
        totals.damping_loss += work.damping;
        let moved = [work.torque, work.stop, work.push, work.contact, work.damping];
        totals.energy_moved += moved.iter().map(|work| work.abs()).sum::<f64>();
    }
}

fn update_foot(
    foot: &Foot,
    report: &mut FootReport,
    step: &ContactStep,
    motion: &BoundaryMotion,
    weight: f64,
    time: f64,
) {
    let dt = step.time_step();
    let pose = motion.kinematics().link_poses_w()[foot.body] * foot.sole;
    report.wrench = pose.inverse_transform_wrench(&step.wrench_w(&foot.contacts));
    let results = || foot.contacts.iter().map(|&i| &step.results()[i]);
    let was_touching = report.touching;
    report.touching = results().any(|result| result.touching);
    let normal = ground_normal(results(), step.terrain());
    let up: Vector3<f64> = pose.rotation.column(2).into();
    report.tilt = match step.ground_is_rigid() {
        true => up.cross(&normal).norm().atan2(up.dot(&normal)),
        false => lift_angle(results()),
    };
    report.slip_speed = patch_speed(results());
    if report.touching {
        if !was_touching {
            report.slip = 0.0;
            report.touch_down = Some(time);
            report.touch_downs += 1;
        }
        if report.slip_speed > SLIP_SPEED {
            report.slip += report.slip_speed * dt;
        }
    } else {
        report.touch_down = None;
    }

    report.pressure_point = None;
    report.pressure_margin = None;
    report.friction_use = 0.0;
    report.torsion_use = 0.0;
    let Wrench { torque, force } = report.wrench;
    if force.z < PRESSURE_SHARE * weight {
        return;
    }
    let point = [-torque.y / force.z, torque.x / force.z];
    report.pressure_point = Some(point);
    report.pressure_margin = (foot.polygon.len() >= 3).then(|| margin(&foot.polygon, point));
    let friction = foot.contacts.iter().map(|&i| step.contacts()[i].friction).fold(f64::INFINITY, f64::min);
    let force_w = pose.rotation * force;
    let along = force_w.dot(&normal);
    report.friction_use = (force_w - normal * along).norm() / (friction * along);
    let center = pose.transform_point(&Vector3::new(point[0], point[1], 0.0));
    let arm: f64 = results().map(|r| r.normal_impulse * (r.mean_point_w - center).norm()).sum();
    // Moment about the normal through the pressure point.
    let about_point = torque - Vector3::new(point[0], point[1], 0.0).cross(&force);
    let limit = friction * arm / dt;
    report.torsion_use =
        if limit > 0.0 { (pose.rotation * about_point).dot(&normal).abs() / limit } else { 0.0 };
}

fn ground_normal<'a>(results: impl Iterator<Item = &'a ContactResult>, terrain: &Terrain) -> Vector3<f64> {
    let sum: Vector3<f64> = results
        .filter(|result| result.touching)
        .map(|result| result.frame.row(2).transpose() * result.normal_impulse)
        .sum();
    sum.try_normalize(0.0).unwrap_or_else(|| terrain.normal_w())
}

/// Tilt of a sole against ground that gives: what sinks with its load is the ground's, so it is the angle under which the highest
/// contact has come off, seen from the lowest one.
fn lift_angle<'a>(results: impl Iterator<Item = &'a ContactResult> + Clone) -> f64 {
    let by_gap = |a: &&ContactResult, b: &&ContactResult| a.gap.total_cmp(&b.gap);
    let Some((highest, lowest)) = results.clone().max_by(by_gap).zip(results.min_by(by_gap)) else {
        return 0.0;
    };
    let distance = (highest.start_w - lowest.start_w).norm();
    if highest.gap <= 0.0 || distance == 0.0 { 0.0 } else { (highest.gap / distance).min(1.0).asin() }
}

fn patch_speed<'a>(results: impl Iterator<Item = &'a ContactResult> + Clone) -> f64 {
    let load: f64 = results.clone().map(|result| result.normal_impulse).sum();
    let (mut count, mut sum) = (0, Vector3::zeros());
    for result in results.filter(|result| result.touching && result.normal_impulse > PATCH_SHARE * load) {
        let mut velocity = result.frame * result.velocity_w;
        velocity.z = 0.0;
        sum += result.frame.tr_mul(&velocity);
        count += 1;
    }
    if count == 0 { 0.0 } else { sum.norm() / f64::from(count) }
}

/// Distance of a point from the edge of a convex polygon (counter-clockwise); negative outside.
pub fn margin(polygon: &[[f64; 2]], point: [f64; 2]) -> f64 {
    let next = polygon.iter().cycle().skip(1);
    polygon.iter().zip(next).fold(f64::INFINITY, |least, (a, b)| {
        let edge = [b[0] - a[0], b[1] - a[1]];
        let length = edge[0].hypot(edge[1]);
        if length == 0.0 {
            return least;
        }
        least.min((edge[0] * (point[1] - a[1]) - edge[1] * (point[0] - a[0])) / length)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_margin_is_the_distance_from_the_nearest_edge() {
        let sole = [[-0.1, -0.05], [0.2, -0.05], [0.2, 0.05], [-0.1, 0.05]];
        assert!((margin(&sole, [0.0, 0.0]) - 0.05).abs() < 1e-15);
        assert!((margin(&sole, [0.19, 0.0]) - 0.01).abs() < 1e-15);
        assert!((margin(&sole, [0.0, 0.08]) + 0.03).abs() < 1e-15);
    }
}

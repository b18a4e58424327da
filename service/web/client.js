import{a,d as b}from"./chunk-6RIED2SA.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};

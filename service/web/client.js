import{a,d as b}from"./chunk-WPAV7VWJ.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
